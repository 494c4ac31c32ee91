-- How likely is each unit's message before the next chance to act?
-- The next chance to act is the next planned check, else the end of the cost table's horizon (30 days). Between the
-- prognosis's points (25 to 300 flights) the hazard is even from point to point.
-- points: as in last_prognoses
-- check_name: the check that is planned next after the aircraft's last flight; NULL where none is
-- until_on: its day; where none is planned the end of horizon_days of the cost table
-- days: from the aircraft's last flight until then [days]
-- flights: the same in flights, at the aircraft's rate [flights]
-- flights_per_day: as in flight_rates
-- chance: of a message by then; NULL where the prognosis does not look so far [-]
-- chance_at_least: of 300 flights, where the check lies beyond them [-]
-- Grain: operator, tail, pack, component. Reads: last_prognoses, flight_rates, tables.raw_checks, tables.raw_costs.
create or replace macro survival_to_point(points, k) as
case when points[k] is not null then ln(greatest(1 - points[k], 1e-9)) end;

create or replace macro chance_between(points, k, share) as
1 - exp(
    survival_to_point(points, k)
    + share * (survival_to_point(points, k + 1) - survival_to_point(points, k))
);

create or replace macro chance_within(points, flights) as
case
    when flights < 25 then chance_between(points, 1, flights / 25)
    when flights < 50 then chance_between(points, 2, (flights - 25) / 25)
    when flights < 100 then chance_between(points, 3, (flights - 50) / 50)
    when flights < 200 then chance_between(points, 4, (flights - 100) / 100)
    when flights <= 300 then chance_between(points, 5, (flights - 200) / 100)
end;

create or replace view check_chances as
with rates as (
    select * from flight_rates
),

horizons as (
    select coalesce(max(horizon_days), 30)::integer as horizon_days from tables.raw_costs
),

checks as (
    select
        f.operator,
        f.tail,
        min(c.planned_on) as planned_on,
        arg_min(c.name, c.planned_on) as name
    from rates as f
    inner join tables.raw_checks as c
        on f.operator = c.operator and f.tail = c.tail and (f.last_departed_at at time zone 'UTC')::date < c.planned_on
    group by f.operator, f.tail
),

spans as (
    select
        f.operator,
        f.tail,
        f.flights_per_day,
        c.name as check_name,
        coalesce(c.planned_on, (f.last_departed_at at time zone 'UTC')::date + h.horizon_days) as until_on,
        until_on - (f.last_departed_at at time zone 'UTC')::date as days,
        days * f.flights_per_day as flights
    from rates as f
    cross join horizons as h
    left join checks as c on f.operator = c.operator and f.tail = c.tail
)

select
    p.*,
    s.check_name,
    s.until_on,
    s.days,
    s.flights,
    s.flights_per_day,
    chance_within(p.points, s.flights) as chance,
    case when s.flights > 300 then p.points[6] end as chance_at_least
from last_prognoses as p
left join spans as s on p.operator = s.operator and p.tail = s.tail;
