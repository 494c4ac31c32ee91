-- Does every estimate say how sure it is and how it ended?
-- A fault: a health parameter with a value and no standard deviation, or the reverse; without status or unit; with a
-- value where the status says there can be none, or none where it says ok. Reads: health_parameters.
select
    operator,
    tail,
    flight_id,
    pack,
    parameter,
    value,
    sd,
    status
from health_parameters
where
    (value is null) <> (sd is null)
    or sd < 0
    or coalesce(status, '') = ''
    or coalesce(unit, '') = ''
    or (status in ('not_identifiable', 'not_recorded') and value is not null)
    or (status = 'ok' and value is null);
