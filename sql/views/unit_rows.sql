-- What stands in the row of each pack, and of each unit of another component, in every output?
-- Chance, forecast and dates of a pack are those of its exchanger or compressor, whichever message has come or is
-- likelier. To one that has come no flights are left, and none are given.
-- component: of a unit that is no pack's; NULL for a pack
-- outlook_component: component that chance, forecast and dates are of
-- loss: of a pack its exchanger's
-- loss_sd: its standard deviation
-- raised_at: when the oldest of the open alerts was raised
-- last_departed_at: departure of its last flight
-- came_at: time of the oldest message that asks for work, by open_messages; NULL where none has come
-- came_flights_ago: flights since
-- alert_id: its most urgent open alert
-- alert_component: component of that alert
-- case_state: state of that alert's case, as in cases
-- owner: who has that case
-- muted_until: until when it is muted
-- data_until: departure of the aircraft's last flight
-- silent_since: since when the aircraft sends nothing, where that is unusual
-- due_status: status of that day, as in due_dates
-- is_overdue: the day of the message is past, by the fleet's last flight
-- is_contradicted: the part was found clean, so that its forecast is of a loss that was not there
-- is_bound: of flights left and day of the message only the lower end is known: no message is near
-- margin_k: reserve of the outlet on a hot day, median of ten flights [K]
-- door_share: share of cruise with the ram door full open, median of ten flights [-]
-- place: 1 is the most urgent; packs and other units have places of their own
-- Grain: operator, tail, pack, component. Reads: fleet_ranking, component_ranking, unit_urgencies, due_dates,
-- open_messages, alert_states, cases, data_gaps, flight_rates, tables.features, flights.
create or replace view unit_rows as
with ranked as (
    select
        operator,
        tail,
        msn,
        pack,
        null::varchar as component,
        null::varchar as name,
        null::varchar as lost,
        hx_fouling as loss,
        hx_fouling_sd as loss_sd,
        urgency,
        diagnoses,
        raised_at,
        last_flight_id,
        last_departed_at,
        missing_since,
        missing_reason,
        missing_columns,
        work_action,
        work_on,
        found_clean_on,
        message_at,
        message_flights,
        message_flown,
        off_since,
        place,
        ['HX', 'CC'] as own_components
    from fleet_ranking
    union all by name
    select
        * exclude (rul_flights, rul_low, rul_high, p_event_50),
        [component] as own_components
    from component_ranking
),

messages_come as (
    select
        r.operator,
        r.tail,
        r.pack,
        r.component,
        min(m.message_at) as came_at,
        arg_min(m.flights_ago, m.message_at) as came_flights_ago
    from ranked as r
    inner join open_messages as m
        on
            r.operator = m.operator
            and r.tail = m.tail
            and r.pack = m.pack
            and list_contains(r.own_components, m.component)
    where m.is_pressing
    group by r.operator, r.tail, r.pack, r.component
),

likeliest as (
    select
        r.operator,
        r.tail,
        r.pack,
        r.component,
        u.component as outlook_component,
        u.rul_flights,
        u.rul_low,
        u.rul_high,
        u.p_event_50,
        u.chance,
        u.chance_kind,
        u.check_name,
        u.until_on,
        u.flights_per_day,
        u.urgent_since,
        u.urgent_by,
        u.status = 'contradicted' as is_contradicted
    from ranked as r
    inner join unit_urgencies as u
        on
            r.operator = u.operator
            and r.tail = u.tail
            and r.pack = u.pack
            and list_contains(r.own_components, u.component)
    where u.is_observed
    qualify
        row_number() over (
            partition by r.operator, r.tail, r.pack, r.component
            order by
                u.urgent_by is not distinct from 'message' desc,
                u.chance desc nulls last,
                list_position(r.own_components, u.component) asc
        ) = 1
),

recent as (
    select
        operator,
        tail,
        pack,
        hx_margin_hot_day_k,
        door_full_open_share
    from tables.features
    qualify row_number() over (partition by operator, tail, pack order by departed_at desc, flight_id desc) <= 10
),

margins as (
    select
        operator,
        tail,
        pack,
        median(hx_margin_hot_day_k) as margin_k,
        median(door_full_open_share) as door_share
    from recent
    group by operator, tail, pack
),

first_alerts as (
    select
        r.operator,
        r.tail,
        r.pack,
        r.component as own_component,
        a.alert_id,
        a.component as alert_component,
        a.diagnosis,
        a.severity,
        a.recommended_action,
        a.action_phrases,
        a.units_in_90_days,
        c.case_id,
        c.state as case_state,
        c.owner,
        c.muted_until
    from ranked as r
    inner join alert_states as a on r.operator = a.operator and r.tail = a.tail and r.pack = a.pack
    inner join cases as c on a.alert_id = c.alert_id
    left join component_ranking as o
        on a.operator = o.operator and a.tail = o.tail and a.pack = o.pack and a.component = o.component
    where a.closed_at is null and r.component is not distinct from o.component
    qualify
        row_number() over (
            partition by r.operator, r.tail, r.pack, r.component order by a.place_in_pack asc
        ) = 1
),

silent as (
    select
        operator,
        tail,
        max(from_at) as silent_since
    from data_gaps
    where gap = 'silent_now'
    group by operator, tail
),

last_flights as (
    select max(departed_at) as until_at from flights
)

select
    r.operator,
    r.tail,
    r.msn,
    r.pack,
    r.component,
    r.name,
    r.lost,
    r.loss,
    r.loss_sd,
    r.urgency,
    r.diagnoses,
    r.raised_at,
    r.last_flight_id,
    r.last_departed_at,
    r.missing_since,
    r.missing_reason,
    r.missing_columns,
    r.work_action,
    r.work_on,
    r.found_clean_on,
    r.message_at,
    r.message_flights,
    r.message_flown,
    r.off_since,
    r.place,
    l.outlook_component,
    c.came_at,
    c.came_flights_ago,
    case when c.came_at is null then l.rul_flights end as rul_flights,
    case when c.came_at is null then l.rul_low end as rul_low,
    case when c.came_at is null then l.rul_high end as rul_high,
    l.p_event_50,
    l.chance,
    l.chance_kind,
    l.check_name,
    l.until_on,
    l.flights_per_day,
    coalesce(l.urgent_since, r.message_at, r.raised_at) as urgent_since,
    l.urgent_by,
    coalesce(l.is_contradicted, false) as is_contradicted,
    d.days_left,
    d.days_left_low,
    d.days_left_high,
    d.due_on,
    d.due_low_on,
    d.due_high_on,
    d.status as due_status,
    l.rul_flights >= 300 or l.p_event_50 < 0.05 as is_bound,
    coalesce(not is_bound and d.due_on < (t.until_at at time zone 'UTC')::date, false) as is_overdue,
    m.margin_k,
    m.door_share,
    a.alert_id,
    a.case_id,
    a.alert_component,
    a.diagnosis,
    a.severity,
    a.recommended_action,
    a.action_phrases,
    a.units_in_90_days,
    a.case_state,
    a.owner,
    a.muted_until,
    f.last_departed_at as data_until,
    s.silent_since
from ranked as r
left join likeliest as l
    on
        r.operator = l.operator
        and r.tail = l.tail
        and r.pack = l.pack
        and r.component is not distinct from l.component
left join messages_come as c
    on
        r.operator = c.operator
        and r.tail = c.tail
        and r.pack = c.pack
        and r.component is not distinct from c.component
left join due_dates as d
    on
        c.came_at is null
        and r.operator = d.operator
        and r.tail = d.tail
        and r.pack = d.pack
        and l.outlook_component = d.component
left join margins as m on r.operator = m.operator and r.tail = m.tail and r.pack = m.pack and r.component is null
left join first_alerts as a
    on
        r.operator = a.operator
        and r.tail = a.tail
        and r.pack = a.pack
        and r.component is not distinct from a.own_component
left join flight_rates as f on r.operator = f.operator and r.tail = f.tail
left join silent as s on r.operator = s.operator and r.tail = s.tail
cross join last_flights as t;
