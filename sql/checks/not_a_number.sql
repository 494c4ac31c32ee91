-- Is there a NaN or an infinity anywhere? What is missing is NULL.
-- A fault: a view with rows that hold one; `n` counts them.
-- Reads: flights, legs, health_parameters, residuals, features, prognoses, design_parameters.
select
    'flights' as view_name,
    count(*) as n
from flights
where to_json(flights)::varchar similar to '.*:-?(NaN|Infinity)[,}].*'
having count(*) > 0
union all
select
    'legs' as view_name,
    count(*) as n
from legs
where to_json(legs)::varchar similar to '.*:-?(NaN|Infinity)[,}].*'
having count(*) > 0
union all
select
    'health_parameters' as view_name,
    count(*) as n
from health_parameters
where to_json(health_parameters)::varchar similar to '.*:-?(NaN|Infinity)[,}].*'
having count(*) > 0
union all
select
    'residuals' as view_name,
    count(*) as n
from residuals
where to_json(residuals)::varchar similar to '.*:-?(NaN|Infinity)[,}].*'
having count(*) > 0
union all
select
    'features' as view_name,
    count(*) as n
from features
where to_json(features)::varchar similar to '.*:-?(NaN|Infinity)[,}].*'
having count(*) > 0
union all
select
    'prognoses' as view_name,
    count(*) as n
from prognoses
where to_json(prognoses)::varchar similar to '.*:-?(NaN|Infinity)[,}].*'
having count(*) > 0
union all
select
    'design_parameters' as view_name,
    count(*) as n
from design_parameters
where to_json(design_parameters)::varchar similar to '.*:-?(NaN|Infinity)[,}].*'
having count(*) > 0;
