-- Which legs are fit to calibrate from, and why not the others?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
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
    v.cruise_minutes,
    (v.departed_at at time zone 'UTC')::date as departed_on
from tables.legs_verdicts as v
left join tables.legs_admitted as a on v.operator = a.operator and v.flight_id = a.flight_id and v.pack = a.pack;
