-- What came of each prognosis, and did its 90 % interval hold?
-- Prognoses on the flight of the event or after it are left out. A life is scored where its end is on record or it
-- outlived 300 more flights, for which 300 stands.
-- outcome: event (a message that a replacement answered), replaced (without one), unheard (replaced, of an operator
-- that delivers no messages), open (the unit flies)
-- seen_flights: flights from the prognosis to that, or to the last flight [flights]
-- interval_held: the event came between rul_low and rul_high, ends included; NULL where it can't be known yet, or never
-- outlived_low: it flew more flights than rul_low; NULL where it can't be known
-- outlived_high: it flew more flights than rul_high; NULL where it can't be known, or where that is the horizon
-- event_50: an event came within 50 flights; NULL where fewer were seen
-- Grain: flight, pack, component. Reads: prognoses, unit_lives.
create or replace view prognosis_outcomes as
with numbered as (
    select
        *,
        row_number() over (partition by operator, tail, pack, component order by departed_at asc, flight_id asc)
        - 1 as row
    from prognoses
),

ended as (
    select
        n.operator,
        n.tail,
        n.flight_id,
        n.pack,
        n.component,
        n.departed_at,
        n.departed_on,
        n.rul_flights,
        n.rul_low,
        n.rul_high,
        n.p_event_50,
        n.model_version,
        n.split,
        l.life,
        l.end_row - n.row as seen_flights,
        case when l.censored then coalesce(l.ended_by, 'open') else 'event' end as outcome
    from numbered as n
    asof inner join unit_lives as l
        on
            n.operator = l.operator
            and n.tail = l.tail
            and n.pack = l.pack
            and n.component = l.component
            and n.row >= l.first_row
),

resolved as (
    select
        *,
        least(seen_flights, 300) as flown,
        outcome = 'event' or seen_flights >= 300 as scored
    from ended
    where seen_flights >= 1
)

select
    * exclude (flown, scored),
    case when scored then flown between rul_low and rul_high end as interval_held,
    case when scored or flown > rul_low then flown > rul_low end as outlived_low,
    case when rul_high < 300 and (scored or flown > rul_high) then flown > rul_high end as outlived_high,
    case when outcome = 'event' and seen_flights <= 50 then true when seen_flights > 50 then false end as event_50
from resolved;
