-- Does every alert hang together?
-- A fault: an alert raised on a flight that is not there or at another time, closed before it was raised, or without a
-- known diagnosis, evidence or action. Reads: alerts, flights, tables.components.
select
    a.alert_id,
    a.operator,
    a.tail,
    a.raised_flight_id,
    a.raised_at,
    a.closed_at,
    a.diagnosis
from alerts as a
left join flights as f on a.operator = f.operator and a.tail = f.tail and a.raised_flight_id = f.flight_id
where
    f.flight_id is null
    or a.raised_at <> f.departed_at
    or a.closed_at < a.raised_at
    or (
        not list_contains(tables.diagnoses(), a.diagnosis)
        and a.diagnosis not in (
            select c.diagnosis from tables.components as c
            where c.recorded
        )
    )
    or a.severity not in ('low', 'medium', 'high')
    or coalesce(a.evidence, '') = ''
    or coalesce(a.recommended_action, '') = '';
