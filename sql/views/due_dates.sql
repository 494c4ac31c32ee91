-- On what day is each pack's failure message to be expected, at the rate at which its aircraft flies?
-- Flights left of the last prognosis over flights a day; days count from the aircraft's last flight.
-- days_left: 50 % point [days]
-- days_left_low: 5 % point [days]
-- days_left_high: 95 % point; NULL where that lies beyond the prognosis's horizon of 300 flights [days]
-- due_on: day of days_left
-- due_low_on: day of days_left_low
-- due_high_on: day of days_left_high
-- flights_per_day: as in flight_rates
-- n_weeks: weeks that rate rests on
-- status: ok; contradicted (the part was found clean since); beyond_horizon (of 300 flights: days_left is a lower
-- bound); no_rate (flights a day unknown); not_known (no prognosis)
-- Grain: operator, tail, pack, component. Reads: last_prognoses, flight_rates.
create or replace view due_dates as
with dated as (
    select
        l.operator,
        l.tail,
        l.pack,
        l.component,
        l.rul_flights,
        l.rul_low,
        l.rul_high,
        l.beyond_horizon,
        l.status as prognosis_status,
        r.last_departed_at,
        r.flights_per_day,
        r.n_weeks,
        l.rul_flights / r.flights_per_day as days_left,
        l.rul_low / r.flights_per_day as days_left_low,
        case when l.rul_high < 300 then l.rul_high / r.flights_per_day end as days_left_high
    from last_prognoses as l
    left join flight_rates as r on l.operator = r.operator and l.tail = r.tail
    where l.is_observed -- a day needs more than what the prior says of any unit
)

select
    operator,
    tail,
    pack,
    component,
    rul_flights,
    rul_low,
    rul_high,
    days_left,
    days_left_low,
    days_left_high,
    (last_departed_at at time zone 'UTC')::date + round(days_left)::integer as due_on,
    (last_departed_at at time zone 'UTC')::date + round(days_left_low)::integer as due_low_on,
    (last_departed_at at time zone 'UTC')::date + round(days_left_high)::integer as due_high_on,
    flights_per_day,
    n_weeks,
    last_departed_at,
    case
        when flights_per_day is null then 'no_rate'
        when prognosis_status != 'ok' then prognosis_status
        when beyond_horizon then 'beyond_horizon'
        else 'ok'
    end as status
from dated;
