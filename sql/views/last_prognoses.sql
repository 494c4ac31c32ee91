-- What was the last prognosis of each unit?
-- departed_at: departure of the flight it was made after
-- points: chance of a message within 0, 25, 50, 100, 200 and 300 flights [-]
-- Grain: operator, tail, pack, component. Reads: prognoses.
create or replace view last_prognoses as
select
    operator,
    tail,
    pack,
    component,
    departed_at,
    rul_flights,
    rul_low,
    rul_high,
    coalesce(beyond_horizon, false) as beyond_horizon,
    p_event_50,
    [0.0, p_event_25, p_event_50, p_event_100, p_event_200, p_event_300] as points,
    status
from prognoses
where p_event_50 is not null
qualify row_number() over (partition by operator, tail, pack, component order by departed_at desc) = 1;
