-- Which packs are most in need of attention tonight?
-- A message on record that nothing has answered stands before any forecast of one. Then, of one urgency, the dearer
-- expected message comes first, then the likelier, then the fewer flights left.
-- urgency: act (such a message, by open_messages, a message before the next chance to act that is more likely than not,
-- or an alert demands it, by unit_urgencies), plan (an alert is open, or that chance is one in ten), none, unknown (no
-- estimate of the unit, or one hardly surer than the prior: its columns are null)
-- hx_fouling: fouling after the last flight [-]
-- hx_fouling_sd: its standard deviation [-]
-- diagnoses: diagnoses of the open alerts, the most urgent first
-- raised_at: when the oldest of them was raised
-- last_flight_id: last flight of the pack
-- last_departed_at: its departure
-- cc_efficiency_loss: loss of compressor efficiency after the last flight [-]
-- cc_efficiency_loss_sd: its standard deviation [-]
-- cc_rul_flights: flights left of the compressor [flights]
-- cc_p_event_50: probability of a compressor event within the next 50 flights [-]
-- place: 1 is the most urgent; what is not known stands last
-- missing_since: departure of the first flight without an estimate, where nothing was seen
-- missing_reason: why most legs since were not admitted; a code, as in legs
-- missing_columns: columns that the estimate needs and that hold no value since
-- work_action: CLEANED or REPLACED, where that was done to the exchanger since the last flight: its columns are null
-- until the next
-- work_on: day of that work
-- message_at: time of the oldest message that nothing has answered
-- message_flights: flights on which it came
-- message_flown: flights since, the message's included
-- off_since: departure of the first flight of the present row of flights with the pack switched off
-- found_clean_on: day of an inspection of the exchanger without a finding since the last flight
-- urgent_since: since when a message, or the chance of one, asks for work now
-- urgent_by: message, flights or fleet, as in unit_urgencies
-- Grain: pack. Reads: health_parameters, missing_estimates, unit_urgencies, unestimated_units,
-- alert_urgencies, airframes, open_messages, clean_units, tables.legs_verdicts, tables.components.
create or replace view fleet_ranking as
with others as (
    select component
    from tables.components
    where recorded
),

estimates as (
    select
        h.operator,
        h.tail,
        h.pack,
        h.flight_id,
        h.departed_at,
        h.parameter,
        case when u.component is null then h.value end as value,
        case when u.component is null then h.sd end as sd
    from health_parameters as h
    left join unestimated_units as u
        on h.operator = u.operator and h.tail = u.tail and h.pack = u.pack and h.component = u.component
    where h.component not in (select o.component from others as o)
),

latest as (
    select
        operator,
        tail,
        pack,
        arg_max(flight_id, departed_at) as last_flight_id,
        max(departed_at) as last_departed_at,
        arg_max(value, departed_at) filter (where parameter = 'hx_fouling') as hx_fouling,
        arg_max(sd, departed_at) filter (where parameter = 'hx_fouling') as hx_fouling_sd,
        arg_max(value, departed_at) filter (where parameter = 'cc_efficiency_loss') as cc_efficiency_loss,
        arg_max(sd, departed_at) filter (where parameter = 'cc_efficiency_loss') as cc_efficiency_loss_sd
    from estimates
    group by operator, tail, pack
),

outlook as (
    select
        operator,
        tail,
        pack,
        any_value(rul_flights) filter (where component = 'HX') as rul_flights,
        any_value(rul_low) filter (where component = 'HX') as rul_low,
        any_value(rul_high) filter (where component = 'HX') as rul_high,
        any_value(p_event_50) filter (where component = 'HX') as p_event_50,
        any_value(rul_flights) filter (where component = 'CC') as cc_rul_flights,
        any_value(p_event_50) filter (where component = 'CC') as cc_p_event_50,
        max(chance) filter (where component in ('HX', 'CC')) as chance,
        max(message_cost) filter (where component in ('HX', 'CC')) as message_cost,
        min(urgent_since) filter (where component in ('HX', 'CC')) as urgent_since,
        arg_min(urgent_by, urgent_since) filter (where component in ('HX', 'CC')) as urgent_by,
        list(urgency) filter (where component in ('HX', 'CC')) as urgencies
    from unit_urgencies
    where
        (operator, tail, pack, component) not in (
            select (u.operator, u.tail, u.pack, u.component)
            from unestimated_units as u
        )
    group by operator, tail, pack
),

diagnosed as (
    select
        operator,
        tail,
        pack,
        diagnosis,
        min(place_in_pack) as first_place,
        min(raised_at) as raised_at,
        bool_or(urgency = 'act') as any_act
    from alert_urgencies
    where closed_at is null and component not in (select o.component from others as o)
    group by operator, tail, pack, diagnosis
),

alerted as (
    select
        operator,
        tail,
        pack,
        string_agg(diagnosis, ', ' order by first_place) as diagnoses,
        min(raised_at) as raised_at,
        bool_or(any_act) as any_act
    from diagnosed
    group by operator, tail, pack
),

unanswered as (
    select
        operator,
        tail,
        pack,
        min(message_at) as message_at,
        arg_min(n_flights, message_at) as message_flights,
        arg_min(n_flown, message_at) as message_flown,
        bool_or(is_pressing) as is_pressing
    from open_messages
    where component not in (select o.component from others as o)
    group by operator, tail, pack
),

last_on as (
    select
        operator,
        tail,
        pack,
        max(departed_at) as departed_at
    from tables.legs_verdicts
    where reason != 'PACK_OFF'
    group by operator, tail, pack
),

switched_off as (
    select
        v.operator,
        v.tail,
        v.pack,
        min(v.departed_at) as off_since
    from tables.legs_verdicts as v
    left join last_on as l on v.operator = l.operator and v.tail = l.tail and v.pack = l.pack
    where v.reason = 'PACK_OFF' and (l.departed_at is null or v.departed_at > l.departed_at)
    group by v.operator, v.tail, v.pack
),

judged as (
    select
        l.operator,
        l.tail,
        l.pack,
        l.hx_fouling,
        l.hx_fouling_sd,
        o.rul_flights,
        o.rul_low,
        o.rul_high,
        o.p_event_50,
        a.diagnoses,
        a.raised_at,
        l.last_flight_id,
        l.last_departed_at,
        l.cc_efficiency_loss,
        l.cc_efficiency_loss_sd,
        o.cc_rul_flights,
        o.cc_p_event_50,
        o.chance,
        o.message_cost,
        o.urgent_since,
        o.urgent_by,
        q.found_clean_on,
        w.work_action,
        w.work_on,
        t.message_at,
        t.message_flights,
        t.message_flown,
        s.off_since,
        coalesce(t.is_pressing, false) as is_pressing,
        coalesce(o.urgencies, []) as urgencies,
        coalesce(a.any_act, false) as any_act
    from latest as l
    left join outlook as o on l.operator = o.operator and l.tail = o.tail and l.pack = o.pack
    left join alerted as a on l.operator = a.operator and l.tail = a.tail and l.pack = a.pack
    left join unanswered as t on l.operator = t.operator and l.tail = t.tail and l.pack = t.pack
    left join switched_off as s on l.operator = s.operator and l.tail = s.tail and l.pack = s.pack
    left join unestimated_units as w
        on l.operator = w.operator and l.tail = w.tail and l.pack = w.pack and w.component = 'HX'
    left join clean_units as q
        on l.operator = q.operator and l.tail = q.tail and l.pack = q.pack and q.component = 'HX'
),

urgent as (
    select
        *,
        case
            when is_pressing or any_act or 'act' in urgencies then 'act'
            when diagnoses is not null or 'plan' in urgencies then 'plan'
            when hx_fouling is null and work_action is null then 'unknown'
            else 'none'
        end as urgency
    from judged
)

select
    u.operator,
    u.tail,
    u.pack,
    u.hx_fouling,
    u.hx_fouling_sd,
    u.rul_flights,
    u.rul_low,
    u.rul_high,
    u.p_event_50,
    u.diagnoses,
    u.raised_at,
    u.last_flight_id,
    u.last_departed_at,
    u.urgency,
    u.cc_efficiency_loss,
    u.cc_efficiency_loss_sd,
    u.cc_rul_flights,
    u.cc_p_event_50,
    row_number() over (
        order by
            list_position(['act', 'plan', 'none', 'unknown'], u.urgency) asc,
            u.is_pressing desc,
            u.message_cost desc nulls last,
            u.chance desc nulls last,
            u.rul_flights asc nulls last,
            u.hx_fouling desc nulls last,
            u.operator asc,
            u.tail asc,
            u.pack asc
    ) as place,
    m.since as missing_since,
    m.reason as missing_reason,
    m.columns as missing_columns,
    u.work_action,
    u.work_on,
    u.message_at,
    u.message_flights,
    u.message_flown,
    u.off_since,
    u.found_clean_on,
    u.urgent_since,
    u.urgent_by,
    n.msn
from urgent as u
left join airframes as n on u.operator = n.operator and u.tail = n.tail
left join missing_estimates as m
    on u.operator = m.operator and u.tail = m.tail and u.pack = m.pack and m.component = 'HX';
