-- How often was each kind of alert right so far?
-- An alert is judged where work or the aircraft's own message confirmed it, or where it closed without either; not
-- while it is open, nor where its unit was replaced without a finding.
-- n_alerts: alerts raised
-- n_judged: of them judged
-- n_right: of these confirmed by a finding or by the aircraft's message
-- n_open: alerts still open
-- n_unjudged: closed alerts that no outcome judges
-- hit_rate: share of the judged that were right [-]
-- hit_rate_low: lower end of its 90 % interval (Wilson) [-]
-- hit_rate_high: upper end [-]
-- Grain: component, diagnosis. Reads: alert_outcomes.
create or replace view alert_hit_rates as
with counted as (
    select
        component,
        diagnosis,
        count(*) as n_alerts,
        count(*) filter (where outcome in ('confirmed', 'message', 'no_fault_found', 'nothing')) as n_judged,
        count(*) filter (where outcome in ('confirmed', 'message')) as n_right,
        count(*) filter (where outcome = 'open') as n_open
    from alert_outcomes
    group by component, diagnosis
),

shares as (
    select
        *,
        n_alerts - n_judged - n_open as n_unjudged,
        n_right / nullif(n_judged, 0) as hit_rate,
        1.645 * 1.645 / nullif(n_judged, 0) as z2_n
    from counted
),

spans as (
    select
        *,
        (hit_rate + z2_n / 2) / (1 + z2_n) as middle,
        sqrt(z2_n * hit_rate * (1 - hit_rate) + z2_n * z2_n / 4) / (1 + z2_n) as half
    from shares
)

select
    component,
    diagnosis,
    n_alerts,
    n_judged,
    n_right,
    n_open,
    n_unjudged,
    hit_rate,
    greatest(middle - half, 0) as hit_rate_low,
    least(middle + half, 1) as hit_rate_high
from spans;
