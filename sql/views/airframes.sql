-- What is the msn of each airframe?
-- operator: operator under which the ranking has it
-- tail: tail under which the ranking has it
-- n_names: operators and tails under which fleet.csv lists it
-- Grain: operator, tail. Reads: aircraft.
create or replace view airframes as
select
    airframe_operator as operator,
    airframe_tail as tail,
    max(msn) as msn,
    count(distinct operator || '/' || tail) as n_names
from aircraft
group by airframe_operator, airframe_tail;
