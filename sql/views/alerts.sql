-- What wants a person's attention, why, and what to do?
-- Grain: alert. Reads: tables.features_alerts.
create or replace view alerts as
select * from tables.features_alerts;
