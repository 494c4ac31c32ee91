-- What wants a person's attention, why, and what to do?
-- raised_on: day of raised_at in UTC; raised_at::date is a day of the session's time zone
-- closed_on: day of closed_at in UTC; work of a day counts from its end
-- case_id: its case, which keeps its id where the data give the alert another
-- Grain: alert. Reads: alert_cases, tables.features_alerts, airframes.
create or replace view alerts as
with own_cases as (
    select distinct
        alert_id,
        case_id
    from alert_cases
)

select
    a.*,
    (a.raised_at at time zone 'UTC')::date as raised_on,
    ((a.closed_at - interval 1 microsecond) at time zone 'UTC')::date as closed_on,
    coalesce(c.case_id, a.alert_id) as case_id,
    n.msn
from tables.features_alerts as a
left join own_cases as c on a.alert_id = c.alert_id
left join airframes as n on a.operator = n.operator and a.tail = n.tail;
