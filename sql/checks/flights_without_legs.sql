-- Has every flight been judged, and is there a flight to every verdict?
-- A fault: a flight with snapshots or seconds and no leg, or a leg of no flight. Reads: flights, legs,
-- component_legs.
select
    f.operator,
    f.tail,
    f.flight_id,
    'no leg' as fault
from flights as f
anti join legs as l on f.operator = l.operator and f.flight_id = l.flight_id
anti join component_legs as c on f.operator = c.operator and f.flight_id = c.flight_id
union all
select distinct
    l.operator,
    l.tail,
    l.flight_id,
    'no flight' as fault
from legs as l
anti join flights as f on l.operator = f.operator and l.flight_id = f.flight_id;
