-- Do times and names agree?
-- A fault: a flight that landed before it left, left more than a day from the date in its name, or whose name is not
-- its tail's; names that a component's own record gives say neither. Reads: flights.
select
    operator,
    tail,
    flight_id,
    departed_at,
    landed_at
from flights
where
    landed_at < departed_at
    or (
        source <> 'component'
        and (
            abs(
                date_diff(
                    'day',
                    try_strptime(flight_id[-11:-4], '%Y%m%d')::date,
                    (departed_at at time zone 'UTC')::date
                )
            ) > 1
            or flight_id[:-13] <> tail
        )
    );
