-- Which alerts were wrong: closed by an inspection that found nothing, or by themselves, without a message?
-- open_days: from raised to closed [days]
-- Grain: alert. Reads: alert_outcomes, alerts.
create or replace view false_alarms as
select
    a.alert_id,
    a.operator,
    a.tail,
    a.pack,
    a.component,
    a.diagnosis,
    a.raised_at,
    a.closed_at,
    (epoch(a.closed_at) - epoch(a.raised_at)) / 86400 as open_days,
    o.outcome,
    a.evidence
from alerts as a
inner join alert_outcomes as o on a.alert_id = o.alert_id
where not o.is_right;
