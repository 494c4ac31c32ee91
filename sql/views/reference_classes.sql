-- How long did other units that came to this loss still fly?
-- The class is the lives of the same component on other airframes, as they stood when the month of the unit's last
-- flight began, of operators that deliver messages. A life belongs to it from the first flight whose loss is as large;
-- not where its record begins far beyond. Flights to the message are Kaplan and Meier's, so that those that still fly
-- and those that were replaced count for as long as they were followed. It is to be shown beside the forecast, not to
-- correct it. Units without an own estimate have no row.
-- loss: loss after the unit's last flight [-]
-- n_units: lives that came to it
-- n_flying: of them still flying without a message
-- n_messages: of them that had the message; the others were replaced without one
-- flights_to_message_median: flights until half had it; NULL where that is not reached [flights]
-- flights_to_message_most: flights within which all n_messages had it [flights]
-- chance_50: share that had it within 50 flights [-]
-- chance_50_low: lower end of its 90 % interval (Wilson, by those whose 50 flights are known) [-]
-- chance_50_high: upper end [-]
-- disagrees: the forecast's chance within 50 flights lies outside that interval, and the median (or, where that is not
-- reached, the longest life followed) outside the forecast's interval of flights left
-- Grain: operator, tail, pack, component. Reads: health_parameters, last_prognoses, unit_lives, tables.components,
-- tables.raw_messages.
create or replace view reference_classes as
with tracks as (
    select
        h.operator,
        h.tail,
        h.pack,
        h.component,
        coalesce(h.msn, h.operator || ' ' || h.tail) as airframe,
        h.departed_at,
        case when h.is_observed then h.value end as loss,
        row_number() over (
            partition by h.operator, h.tail, h.pack, h.component order by h.departed_at, h.flight_id
        ) as n
    from health_parameters as h
    inner join tables.components as c on h.component = c.component and h.parameter = c.loss
),

units as (
    select
        p.operator,
        p.tail,
        p.pack,
        p.component,
        any_value(t.airframe) as airframe,
        arg_max(t.loss, t.departed_at) as loss,
        date_trunc('month', max(t.departed_at) at time zone 'UTC') at time zone 'UTC' as month_began,
        any_value(p.p_event_50) as p_event_50,
        any_value(p.rul_low) as rul_low,
        any_value(p.rul_high) as rul_high
    from last_prognoses as p
    inner join tracks as t
        on p.operator = t.operator and p.tail = t.tail and p.pack = t.pack and p.component = t.component
    where p.is_observed and t.loss is not null
    group by p.operator, p.tail, p.pack, p.component
),

flown as (
    select
        t.*,
        l.ended_by,
        l.end_departed_at,
        [t.operator, t.tail, t.pack::varchar, t.component, l.life::varchar] as unit_life
    from tracks as t
    asof inner join unit_lives as l
        on
            t.operator = l.operator
            and t.tail = l.tail
            and t.pack = l.pack
            and t.component = l.component
            and t.departed_at >= l.first_departed_at
    where
        t.departed_at <= coalesce(l.end_departed_at, 'infinity')
        and t.operator in (select m.operator from tables.raw_messages as m)
),

rises as (
    select
        *,
        row_number() over life = 1 as is_first
    from flown
    where loss is not null
    window life as (partition by unit_life order by n)
    qualify coalesce(loss > max(loss) over (life rows between unbounded preceding and 1 preceding), true)
),

months as (
    select distinct month_began
    from units
),

followed as (
    select
        m.month_began,
        f.unit_life,
        max(f.n) as last_n,
        any_value(f.end_departed_at < m.month_began and f.ended_by is not null) as has_ended,
        any_value(f.end_departed_at < m.month_began and f.ended_by = 'message') as had_message
    from months as m
    inner join flown as f on m.month_began > f.departed_at
    group by m.month_began, f.unit_life
),

reached as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        u.month_began,
        r.unit_life,
        min(r.n) as n
    from units as u
    inner join rises as r
        on
            u.component = r.component
            and u.airframe != r.airframe
            and u.month_began > r.departed_at
            and u.loss <= r.loss
    group by u.operator, u.tail, u.pack, u.component, u.month_began, u.loss, r.unit_life
    having not bool_or(r.is_first and r.loss > u.loss + 0.05)
),

classes as (
    select
        r.*,
        f.last_n - r.n as flights,
        coalesce(f.had_message, false) as had_message,
        coalesce(f.has_ended, false) as has_ended
    from reached as r
    inner join followed as f on r.month_began = f.month_began and r.unit_life = f.unit_life
),

ends as (
    select
        operator,
        tail,
        pack,
        component,
        flights,
        count(*) filter (where had_message) as n_messages,
        sum(count(*)) over (
            partition by operator, tail, pack, component order by flights desc
        ) as n_followed
    from classes
    group by operator, tail, pack, component, flights
),

survivals as (
    select
        *,
        product(1 - n_messages / n_followed) over (
            partition by operator, tail, pack, component order by flights
        ) as survival
    from ends
),

shares as (
    select
        operator,
        tail,
        pack,
        component,
        min(flights) filter (where survival <= 0.5) as flights_to_message_median,
        1 - coalesce(min(survival) filter (where flights <= 50), 1) as chance_50
    from survivals
    group by operator, tail, pack, component
),

counts as (
    select
        operator,
        tail,
        pack,
        component,
        count(*) as n_units,
        count(*) filter (where not has_ended) as n_flying,
        count(*) filter (where had_message) as n_messages,
        max(flights) filter (where had_message) as flights_to_message_most,
        max(flights) as flights_most,
        count(*) filter (where flights >= 50 or had_message) as n_known
    from classes
    group by operator, tail, pack, component
),

intervals as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        u.loss,
        u.p_event_50,
        u.rul_low,
        u.rul_high,
        coalesce(c.n_units, 0) as n_units,
        coalesce(c.n_flying, 0) as n_flying,
        coalesce(c.n_messages, 0) as n_messages,
        s.flights_to_message_median,
        c.flights_to_message_most,
        c.flights_most,
        case when c.n_known > 0 then s.chance_50 end as chance_50,
        1.645 * 1.645 / nullif(c.n_known, 0) as z2_n
    from units as u
    left join counts as c
        on u.operator = c.operator and u.tail = c.tail and u.pack = c.pack and u.component = c.component
    left join shares as s
        on u.operator = s.operator and u.tail = s.tail and u.pack = s.pack and u.component = s.component
),

spans as (
    select
        *,
        (chance_50 + z2_n / 2) / (1 + z2_n) as middle,
        sqrt(z2_n * chance_50 * (1 - chance_50) + z2_n * z2_n / 4) / (1 + z2_n) as half
    from intervals
)

select
    operator,
    tail,
    pack,
    component,
    loss,
    n_units,
    n_flying,
    n_messages,
    flights_to_message_median,
    flights_to_message_most,
    chance_50,
    greatest(middle - half, 0) as chance_50_low,
    least(middle + half, 1) as chance_50_high,
    coalesce(
        p_event_50 not between chance_50_low and chance_50_high
        and (
            flights_to_message_median < rul_low
            or (coalesce(flights_to_message_median, flights_most) > rul_high and rul_high < 300)
        ),
        false
    ) as disagrees
from spans;
