-- Is anything said twice?
-- A fault: a key of a view that more than one row has.
-- Reads: flights, legs, health_parameters, residuals, features, prognoses,
-- alerts, design_parameters, deliveries.
select
    'flights' as view_name,
    [operator::varchar, tail::varchar, flight_id::varchar] as key_values,
    count(*) as n
from flights
group by operator, tail, flight_id
having count(*) > 1
union all
select
    'legs' as view_name,
    [operator::varchar, tail::varchar, flight_id::varchar, pack::varchar] as key_values,
    count(*) as n
from legs
group by operator, tail, flight_id, pack
having count(*) > 1
union all
select
    'health_parameters' as view_name,
    [operator::varchar, tail::varchar, flight_id::varchar, pack::varchar, parameter::varchar] as key_values,
    count(*) as n
from health_parameters
group by operator, tail, flight_id, pack, parameter
having count(*) > 1
union all
select
    'residuals' as view_name,
    [operator::varchar, tail::varchar, flight_id::varchar, pack::varchar, signal::varchar, kind::varchar] as key_values,
    count(*) as n
from residuals
group by operator, tail, flight_id, pack, signal, kind
having count(*) > 1
union all
select
    'features' as view_name,
    [operator::varchar, tail::varchar, flight_id::varchar, pack::varchar] as key_values,
    count(*) as n
from features
group by operator, tail, flight_id, pack
having count(*) > 1
union all
select
    'prognoses' as view_name,
    [operator::varchar, tail::varchar, flight_id::varchar, pack::varchar, component::varchar] as key_values,
    count(*) as n
from prognoses
group by operator, tail, flight_id, pack, component
having count(*) > 1
union all
select
    'alerts' as view_name,
    [alert_id::varchar] as key_values,
    count(*) as n
from alerts
group by alert_id
having count(*) > 1
union all
select
    'design_parameters' as view_name,
    [scope, operator, tail, pack::varchar, component, parameter] as key_values,
    count(*) as n
from design_parameters
group by scope, operator, tail, pack, component, parameter
having count(*) > 1
union all
select
    'deliveries' as view_name,
    [file::varchar] as key_values,
    count(*) as n
from deliveries
group by file
having count(*) > 1;
