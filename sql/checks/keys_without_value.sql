-- Is a key empty?
-- A fault: a view with rows whose key, or a column that must be there, is NULL; `n` counts them.
-- Reads: flights, legs, health_parameters, residuals, features, prognoses, alerts, design_parameters,
-- deliveries, quarantine.
select
    'flights' as view_name,
    count(*) as n
from flights
where
    operator is null
    or tail is null
    or flight_id is null
    or departed_at is null
having count(*) > 0
union all
select
    'legs' as view_name,
    count(*) as n
from legs
where
    operator is null
    or tail is null
    or flight_id is null
    or pack is null
    or admitted is null
    or reason is null
having count(*) > 0
union all
select
    'health_parameters' as view_name,
    count(*) as n
from health_parameters
where
    operator is null
    or tail is null
    or flight_id is null
    or pack is null
    or departed_at is null
    or component is null
    or parameter is null
having count(*) > 0
union all
select
    'residuals' as view_name,
    count(*) as n
from residuals
where
    operator is null
    or tail is null
    or flight_id is null
    or pack is null
    or component is null
    or signal is null
    or kind is null
having count(*) > 0
union all
select
    'features' as view_name,
    count(*) as n
from features
where
    operator is null
    or tail is null
    or flight_id is null
    or pack is null
    or departed_at is null
having count(*) > 0
union all
select
    'prognoses' as view_name,
    count(*) as n
from prognoses
where
    operator is null
    or tail is null
    or flight_id is null
    or pack is null
    or component is null
    or departed_at is null
    or model_version is null
    or split is null
having count(*) > 0
union all
select
    'alerts' as view_name,
    count(*) as n
from alerts
where
    alert_id is null
    or operator is null
    or tail is null
    or pack is null
    or component is null
    or diagnosis is null
    or raised_flight_id is null
    or raised_at is null
having count(*) > 0
union all
select
    'design_parameters' as view_name,
    count(*) as n
from design_parameters
where
    scope is null
    or component is null
    or parameter is null
    or dsm_version is null
having count(*) > 0
union all
select
    'deliveries' as view_name,
    count(*) as n
from deliveries
where
    file is null
    or delivered is null
    or loaded is null
    or quarantined is null
    or duplicate is null
having count(*) > 0
union all
select
    'quarantine' as view_name,
    count(*) as n
from quarantine
where
    file is null
    or reason is null
having count(*) > 0;
