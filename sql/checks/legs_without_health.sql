-- Does the chain go through: of every leg a health estimate, features and a prognosis?
-- A fault: a leg of a pack that a later stage has not, or a row of a later stage of no leg. Declared components may
-- fly on some of the legs. Reads: legs, component_legs, health_parameters, features, prognoses, residuals,
-- quarantine (legs of which a row was set aside).
with every_leg as (
    select
        operator,
        flight_id,
        pack
    from legs
    union
    select
        operator,
        flight_id,
        pack
    from component_legs
),

later as (
    select distinct
        operator,
        flight_id,
        pack,
        'health_parameters' as stage
    from health_parameters
    union all
    select distinct
        operator,
        flight_id,
        pack,
        'features' as stage
    from features
    union all
    select distinct
        operator,
        flight_id,
        pack,
        'prognoses' as stage
    from prognoses
),

stages as (
    select distinct stage
    from later
),

wanted as (
    select
        l.operator,
        l.flight_id,
        l.pack,
        s.stage
    from legs as l
    cross join stages as s
    where
        not exists (
            select 1 from quarantine as q
            where q.reason = 'breaks_declaration' and q.operator = l.operator and q.flight_id = l.flight_id
        )
)

select
    w.operator,
    w.flight_id,
    w.pack,
    w.stage,
    'missing' as fault
from wanted as w
anti join later as d
    on w.operator = d.operator and w.flight_id = d.flight_id and w.pack = d.pack and w.stage = d.stage
union all
select
    d.operator,
    d.flight_id,
    d.pack,
    d.stage,
    'of no leg' as fault
from later as d
anti join every_leg as l on d.operator = l.operator and d.flight_id = l.flight_id and d.pack = l.pack
union all
select distinct
    r.operator,
    r.flight_id,
    r.pack,
    'residuals' as stage,
    'of no leg' as fault
from residuals as r
anti join every_leg as l on r.operator = l.operator and r.flight_id = l.flight_id and r.pack = l.pack;
