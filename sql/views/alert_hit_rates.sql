-- How often was each kind of alert right so far?
-- By the verdicts of alert_outcomes, and by the aircraft's message alone, which an alert acted on in time never has.
-- n_alerts: alerts raised
-- n_judged: of them judged: not open, and their outcome known
-- n_right: of these found, answered or followed by the message
-- n_message: of the judged followed by the message
-- n_open: alerts still open
-- n_unjudged: closed alerts whose outcome is not yet known
-- hit_rate: share of the judged that were right [-]
-- hit_rate_low: lower end of its 90 % interval (Wilson) [-]
-- hit_rate_high: upper end [-]
-- message_rate: share of the judged that the message followed; NULL where the component has none [-]
-- message_rate_low: lower end of its 90 % interval (Wilson) [-]
-- message_rate_high: upper end [-]
-- Grain: component, diagnosis. Reads: alert_outcomes, tables.components.
create or replace view alert_hit_rates as
with heard as (
    select component
    from tables.components
    where message_code is not null
),

counted as (
    select
        component,
        diagnosis,
        count(*) as n_alerts,
        count(is_right) as n_judged,
        count(*) filter (where is_right) as n_right,
        count(is_right) filter (where n_messages > 0) as n_message,
        count(*) filter (where outcome = 'open') as n_open,
        component in (select h.component from heard as h) as has_message
    from alert_outcomes
    group by component, diagnosis
),

shares as (
    select
        component,
        diagnosis,
        n_judged,
        unnest(['right', 'message']) as kind,
        unnest([n_right, case when has_message then n_message end]) / nullif(n_judged, 0) as share,
        1.645 * 1.645 / nullif(n_judged, 0) as z2_n
    from counted
),

spans as (
    select
        *,
        (share + z2_n / 2) / (1 + z2_n) as middle,
        sqrt(z2_n * share * (1 - share) + z2_n * z2_n / 4) / (1 + z2_n) as half
    from shares
)

select
    c.component,
    c.diagnosis,
    c.n_alerts,
    c.n_judged,
    c.n_right,
    c.n_message,
    c.n_open,
    c.n_alerts - c.n_judged - c.n_open as n_unjudged,
    r.share as hit_rate,
    case when r.share is not null then greatest(r.middle - r.half, 0) end as hit_rate_low,
    case when r.share is not null then least(r.middle + r.half, 1) end as hit_rate_high,
    m.share as message_rate,
    case when m.share is not null then greatest(m.middle - m.half, 0) end as message_rate_low,
    case when m.share is not null then least(m.middle + m.half, 1) end as message_rate_high
from counted as c
inner join spans as r on c.component = r.component and c.diagnosis = r.diagnosis and r.kind = 'right'
inner join spans as m on c.component = m.component and c.diagnosis = m.diagnosis and m.kind = 'message';
