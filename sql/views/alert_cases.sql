-- Which case is each alert's, and by which names is it known?
-- A case goes on where its alert has another first flight, and so another id, since the model was estimated again: the
-- log of cases has a line then. Without one the case has the id of its alert. Where several cases came together in one
-- alert, it has the id of the one that was there first.
-- case_id: id of the alert's case
-- known_as: the id of the case, or one that its alert has or had; a row for each
-- Grain: known_as. Reads: tables.features_alerts, tables.raw_cases.
create or replace view alert_cases as
with named as (
    select
        case_id,
        alert_id,
        min(line) as first_line,
        max(line) as last_line
    from tables.raw_cases
    group by case_id, alert_id
),

present as (
    select n.*
    from named as n
    inner join tables.features_alerts as a on n.alert_id = a.alert_id
),

last_held as (
    select
        case_id,
        arg_max(alert_id, last_line) as alert_id
    from present
    group by case_id
),

held as (
    select p.*
    from present as p
    inner join last_held as l on p.case_id = l.case_id and p.alert_id = l.alert_id
),

own_cases as (
    select
        a.alert_id,
        coalesce(arg_min(h.case_id, h.first_line), a.alert_id) as case_id
    from tables.features_alerts as a
    left join held as h on a.alert_id = h.alert_id
    group by a.alert_id
),

names as (
    select
        alert_id,
        case_id as known_as,
        1 as place
    from held
    union all
    select
        alert_id,
        alert_id as known_as,
        2 as place
    from own_cases
    union all
    select
        h.alert_id,
        n.alert_id as known_as,
        3 as place
    from held as h
    inner join named as n on h.case_id = n.case_id
)

select
    c.alert_id,
    c.case_id,
    n.known_as
from own_cases as c
inner join names as n on c.alert_id = n.alert_id
qualify row_number() over (partition by n.known_as order by n.place asc, c.alert_id asc) = 1;
