-- What wants a person's attention, why, and what to do?
-- raised_on: day of raised_at in UTC; raised_at::date is a day of the session's time zone
-- closed_on: day of closed_at in UTC
-- Grain: alert. Reads: tables.features_alerts.
create or replace view alerts as
select
    *,
    (raised_at at time zone 'UTC')::date as raised_on,
    (closed_at at time zone 'UTC')::date as closed_on
from tables.features_alerts;
