-- What was known of each pack on the night of each flight, and what came of it?
-- Features are of that flight and those before it; columns that begin with label_ are of later flights and are no
-- features. See docs/catalog.md for their use and test.
-- split_tail: aircraft, to be held out together
-- split_unit: heat exchanger, to be held out together; another one flies after each replacement
-- as_stated: no flight that calibrated the models departed later, so that night had just this row
-- label_hx_flights: flights until the heat exchanger's event, 0 on its own flight; of a censored row flights without
-- one; NULL after the event, while the unit still flies [flights]
-- label_hx_censored: no event ended the unit's life, or none yet; NULL where label_hx_flights is
-- label_hx_ended_by: message (the event), replaced (without a message), unheard (replaced, of an operator that delivers
-- no messages), NULL while the unit flies
-- label_cc_flights: the same of the compressor [flights]
-- label_cc_censored: the same of the compressor
-- label_cc_ended_by: the same of the compressor
-- Grain: flight, pack. Reads: features, unit_lives, tables.calibration_window.
create or replace view training_set as
with numbered as (
    select
        *,
        row_number() over (partition by operator, tail, pack order by departed_at asc, flight_id asc) - 1 as row
    from features
),

learned as (
    select max(until_at) as until_at from tables.calibration_window
),

exchangers as (
    select * from unit_lives
    where component = 'HX'
),

compressors as (
    select * from unit_lives
    where component = 'CC'
),

joined as (
    select
        n.*,
        coalesce(n.departed_at >= l.until_at, false) as as_stated,
        x.life as hx_life,
        x.censored as hx_censored,
        x.ended_by as hx_ended_by,
        x.end_row - n.row as hx_left,
        c.censored as cc_censored,
        c.ended_by as cc_ended_by,
        c.end_row - n.row as cc_left
    from numbered as n
    cross join learned as l
    asof left join exchangers as x
        on n.operator = x.operator and n.tail = x.tail and n.pack = x.pack and n.row >= x.first_row
    asof left join compressors as c
        on n.operator = c.operator and n.tail = c.tail and n.pack = c.pack and n.row >= c.first_row
)

select
    * exclude (
        row,
        as_stated,
        hx_life,
        hx_left,
        hx_censored,
        hx_ended_by,
        cc_left,
        cc_censored,
        cc_ended_by
    ),
    operator || '/' || tail as split_tail,
    operator || '/' || tail || '/' || pack || '/' || hx_life as split_unit,
    as_stated,
    case when hx_left >= 0 then hx_left end as label_hx_flights,
    case when hx_left >= 0 then hx_censored end as label_hx_censored,
    hx_ended_by as label_hx_ended_by,
    case when cc_left >= 0 then cc_left end as label_cc_flights,
    case when cc_left >= 0 then cc_censored end as label_cc_censored,
    cc_ended_by as label_cc_ended_by
from joined;
