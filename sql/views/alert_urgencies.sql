-- How urgent is each alert now?
-- Now is the pack's last flight or, of a closed alert, the last while it was open.
-- urgency: act (open, and its unit is by unit_urgencies or, where that has no chance, its severity is high), plan
-- (open), none (closed)
-- now_rul_flights: flights left now [flights]
-- now_rul_low: lower end of the 90 % interval of that [flights]
-- now_rul_high: upper end [flights]
-- now_p_event_50: probability of an event within 50 flights now [-]
-- place_in_pack: 1 is the pack's most urgent alert; then the most severe, then the oldest
-- Grain: alert. Reads: alerts, prognoses, unit_urgencies.
create or replace view alert_urgencies as
with predicted as (
    select
        a.*,
        p.rul_flights as now_rul_flights,
        p.rul_low as now_rul_low,
        p.rul_high as now_rul_high,
        p.p_event_50 as now_p_event_50,
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
