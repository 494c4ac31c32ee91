-- How urgent is each alert now?
-- Now is the pack's last flight or, of a closed alert, the last while it was open.
-- urgency: act (open, and its unit is by unit_urgencies or, where that has no chance, its severity is high), plan
-- (open), none (closed)
-- now_rul_flights: flights left now; NULL where the message has come [flights]
-- now_rul_low: lower end of the 90 % interval of that [flights]
-- now_rul_high: upper end [flights]
-- now_p_event_50: probability of an event within 50 flights now [-]
-- now_came_at: time of the oldest message of its component that asks for work, by open_messages; NULL where none has
-- come, and where the alert is closed
-- now_came_flights_ago: flights since
-- place_in_pack: 1 is the pack's most urgent alert; then the most severe, then the oldest
-- Grain: alert. Reads: alerts, prognoses, unit_urgencies, open_messages.
create or replace view alert_urgencies as
with predicted as (
    select
        a.*,
        case when m.message_at is null then p.rul_flights end as now_rul_flights,
        case when m.message_at is null then p.rul_low end as now_rul_low,
        case when m.message_at is null then p.rul_high end as now_rul_high,
        p.p_event_50 as now_p_event_50,
        m.message_at as now_came_at,
        m.flights_ago as now_came_flights_ago,
        case
            when a.closed_at is not null then 'none'
            when u.urgency = 'act' or (u.chance is null and a.severity = 'high') then 'act'
            else 'plan'
        end as urgency
    from alerts as a
    left join prognoses as p
        on
            a.operator = p.operator
            and a.tail = p.tail
            and a.now_flight_id = p.flight_id
            and a.pack = p.pack
            and a.component = p.component
    left join open_messages as m
        on
            a.operator = m.operator
            and a.tail = m.tail
            and a.pack = m.pack
            and a.component = m.component
            and m.is_pressing
            and a.closed_at is null
    left join unit_urgencies as u
        on a.operator = u.operator and a.tail = u.tail and a.pack = u.pack and a.component = u.component
)

select
    *,
    row_number() over (
        partition by operator, tail, pack
        order by
            list_position(['act', 'plan', 'none'], urgency) asc,
            list_position(['high', 'medium', 'low'], severity) asc,
            raised_at asc,
            alert_id asc
    ) as place_in_pack
from predicted;
