-- Which flights are not used as delivered, why, and what made them so?
-- departed_at: as delivered
-- likely_cause: null where the numbers show none
-- reason: of packs_exchanged the flights are used, each pack in its own place; of any other they are not
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
    h.likely_cause,
    h.held_since,
    h.other_flight_id
from tables.record_held as h
left join airframes as f on h.operator = f.operator and h.tail = f.tail;
