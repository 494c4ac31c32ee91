-- How urgent is each alert now?
-- Now is the pack's last flight or, of a closed alert, the last while it was open.
-- urgency: act (open, and of high severity now or a message of its component within 50 flights more likely than not),
-- plan (open), none (closed); what an inspection contradicts does not say act
-- now_rul_flights: flights left now [flights]
-- now_rul_low: lower end of the 90 % interval of that [flights]
-- now_rul_high: upper end [flights]
-- now_p_event_50: probability of an event within 50 flights now [-]
-- place_in_pack: 1 is the pack's most urgent alert; then the most severe, then the oldest
-- Grain: alert. Reads: alerts, prognoses.
create or replace view alert_urgencies as
with foretold as (
    select
        a.*,
        p.rul_flights as now_rul_flights,
        p.rul_low as now_rul_low,
        p.rul_high as now_rul_high,
        p.p_event_50 as now_p_event_50,
        case
            when a.closed_at is not null then 'none'
            when a.severity = 'high' or (p.p_event_50 >= 0.5 and p.status = 'ok') then 'act'
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
from foretold;
