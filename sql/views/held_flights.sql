-- Which flights are not used as delivered, why, and what made them so?
-- departed_at: as delivered
-- likely_cause: null where the numbers show none
-- is_used: of packs_exchanged each pack in its own place, of log_contradicts without the log
-- Grain: flight. Reads: tables.record_held, airframes.
create or replace view held_flights as
select
    h.operator,
    h.tail,
    f.msn,
    h.flight_id,
    h.departed_at,
    h.file,
    h.reason,
    h.is_used,
    h.likely_cause,
    h.held_since,
    h.other_flight_id
from tables.record_held as h
left join airframes as f on h.operator = f.operator and h.tail = f.tail;
