-- Which packs foul faster than the fleet?
-- fleet_per_100_flights: median of the fleet's units [1/100 flights]
-- operator_per_100_flights: median of the operator's units [1/100 flights]
-- above_fleet: fouling_per_100_flights less the fleet's median [1/100 flights]
-- in_service: still fitted
-- Grain: operator, tail, pack, unit, of at least 30 flights. Reads: exchanger_lives.
create or replace view fouling_fast as
select
    operator,
    tail,
    pack,
    unit,
    n_flights,
    fouling_per_100_flights,
    median(fouling_per_100_flights) over () as fleet_per_100_flights,
    median(fouling_per_100_flights) over (partition by operator) as operator_per_100_flights,
    fouling_per_100_flights - median(fouling_per_100_flights) over () as above_fleet,
    removed_on is null as in_service
from exchanger_lives
where n_flights >= 30 and fouling_per_100_flights is not null
qualify above_fleet > 0;
