-- What was the last prognosis of each unit?
-- departed_at: departure of the flight it was made after
-- points: chance of a message within 0, 25, 50, 100, 200 and 300 flights [-]
-- status: as in prognoses, renewed (washed or replaced since) or contradicted (found clean since)
-- is_observed: neither prior_only nor renewed
-- Grain: operator, tail, pack, component. Reads: prognoses, renewed_units, clean_units.
create or replace view last_prognoses as
select
    p.operator,
    p.tail,
    p.pack,
    p.component,
    p.departed_at,
    p.rul_flights,
    p.rul_low,
    p.rul_high,
    coalesce(p.beyond_horizon, false) as beyond_horizon,
    p.p_event_50,
    [0.0, p.p_event_25, p.p_event_50, p.p_event_100, p.p_event_200, p.p_event_300] as points,
    case
        when r.component is not null then 'renewed'
        when c.component is not null then 'contradicted'
        else p.status
    end as status,
    r.component is null and p.status != 'prior_only' as is_observed
from prognoses as p
left join renewed_units as r
    on p.operator = r.operator and p.tail = r.tail and p.pack = r.pack and p.component = r.component
left join clean_units as c
    on p.operator = c.operator and p.tail = c.tail and p.pack = c.pack and p.component = c.component
where p.p_event_50 is not null
qualify row_number() over (partition by p.operator, p.tail, p.pack, p.component order by p.departed_at desc) = 1;
