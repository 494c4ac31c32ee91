-- Which airframe flew under which operator and tail, and when?
-- An airframe is its msn or, where that is null, its operator and tail.
-- airframe_operator: operator under which the ranking has the airframe
-- airframe_tail: tail under which the ranking has it; numbered where another airframe has the tail now
-- flight_prefix: null where no line of fleet.csv names the operator and tail
-- Grain: operator, tail, msn, valid_from. Reads: tables.raw_fleet, tables.raw_flights.
create or replace view aircraft as
with unlisted as (
    select distinct
        f.operator,
        f.tail
    from tables.raw_flights as f
    anti join tables.raw_fleet as l on f.operator = l.airframe_operator and f.tail = l.airframe_tail
)

select
    msn,
    operator,
    tail,
    valid_from,
    valid_to,
    delivered_on,
    packs,
    type,
    airframe_operator,
    airframe_tail,
    flight_prefix
from tables.raw_fleet
union all
select
    null as msn,
    operator,
    tail,
    null as valid_from,
    null as valid_to,
    null as delivered_on,
    null as packs,
    null as type,
    operator as airframe_operator,
    tail as airframe_tail,
    null as flight_prefix
from unlisted;
