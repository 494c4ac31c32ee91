-- Which legs are fit to calibrate from, and why not the others?
-- Grain: flight, pack. Reads: tables.legs_verdicts, tables.legs_admitted.
create or replace view legs as
select
    v.operator,
    v.tail,
    v.flight_id,
    v.pack,
    coalesce(a.admitted, v.admitted) as admitted,
    coalesce(a.reason, v.reason) as reason,
    v.n_samples,
    v.n_nominal,
    v.departed_at,
    v.cruise_minutes
from tables.legs_verdicts as v
left join tables.legs_admitted as a on v.operator = a.operator and v.flight_id = a.flight_id and v.pack = a.pack;
