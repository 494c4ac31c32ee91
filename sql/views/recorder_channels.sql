-- Which channels does a recorder deliver otherwise than one reading a row, since when, and in how many flights?
-- source: acms or cpl
-- signal: signal as the tables name it
-- reason: not_fitted, one_channel or lower_rate, as in `hdt docs bad-input`
-- since_flight_id: first flight of it
-- until_flight_id: last flight of it
-- n_flights: flights of it
-- delivered_share: of a lower rate, share of the rows that hold a reading, mean over the flights
-- Grain: operator, tail, pack, source, signal, reason. Reads: tables.legs_channels.
create or replace view recorder_channels as
select
    operator,
    tail,
    pack,
    source,
    signal,
    reason,
    arg_min(flight_id, right(flight_id, 11)) as since_flight_id,
    arg_max(flight_id, right(flight_id, 11)) as until_flight_id,
    count(*) as n_flights,
    avg(delivered_share) as delivered_share
from tables.legs_channels
group by operator, tail, pack, source, signal, reason;
