-- Does every prognosis lie within its interval, and is every chance a chance?
-- A fault: a prognosis below its low end, above its high end, or with half an interval. Reads: prognoses.
select
    operator,
    tail,
    flight_id,
    pack,
    component,
    rul_low,
    rul_flights,
    rul_high,
    p_event_50
from prognoses
where
    not coalesce(rul_low <= rul_flights and rul_flights <= rul_high, true)
    or coalesce(rul_low, 0) < 0
    or not coalesce(p_event_50 between 0 and 1, true)
    or (rul_low is null) <> (rul_high is null)
    or (rul_flights is null) <> (rul_low is null)
    or split not in ('out_of_fold', 'live');
