-- What was true of each alert when it was raised, and what is true now?
-- Now is the pack's last flight or, of a closed alert, the last while it was open. Loss: the one that ends the life of
-- the alert's component (exchanger: conductance, compressor: efficiency); NULL for doors and sensors.
-- diagnosis: of the alert, as in alerts
-- now_departed_at: departure of now_flight_id
-- raised_loss: loss when raised [-]
-- raised_loss_sd: its standard deviation [-]
-- raised_rul_flights: flights left, as predicted when raised [flights]
-- raised_rul_low: lower end of the 90 % interval of that [flights]
-- raised_rul_high: upper end [flights]
-- raised_p_event_50: probability of an event within 50 flights, as predicted when raised [-]
-- now_loss: loss now [-]
-- now_loss_sd: its standard deviation [-]
-- Grain: alert. Reads: alert_urgencies, flights, health_parameters, prognoses, tables.components.
create or replace view alert_states as
with losses as (
    select h.*
    from health_parameters as h
    inner join tables.components as c on h.component = c.component and h.parameter = c.loss
)

select
    a.*,
    f.departed_at as now_departed_at,
    l0.value as raised_loss,
    l0.sd as raised_loss_sd,
    p0.rul_flights as raised_rul_flights,
    p0.rul_low as raised_rul_low,
    p0.rul_high as raised_rul_high,
    p0.p_event_50 as raised_p_event_50,
    l1.value as now_loss,
    l1.sd as now_loss_sd
from alert_urgencies as a
left join flights as f on a.operator = f.operator and a.tail = f.tail and a.now_flight_id = f.flight_id
left join losses as l0
    on
        a.operator = l0.operator
        and a.tail = l0.tail
        and a.raised_flight_id = l0.flight_id
        and a.pack = l0.pack
        and a.component = l0.component
left join losses as l1
    on
        a.operator = l1.operator
        and a.tail = l1.tail
        and a.now_flight_id = l1.flight_id
        and a.pack = l1.pack
        and a.component = l1.component
left join prognoses as p0
    on
        a.operator = p0.operator
        and a.tail = p0.tail
        and a.raised_flight_id = p0.flight_id
        and a.pack = p0.pack
        and a.component = p0.component;
