-- What is missing where nothing is seen of a unit tonight, or an exchanger or compressor is not seen for 15 flights?
-- n_flights: its flights since then, none of which moved the estimate
-- since: departure of the first of them
-- reason: why most of their legs were not admitted; a code, as in legs, or NO_ROWS: they hold no row of the pack
-- columns: what the exchanger's estimate needs and holds hardly a value in most of these flights, names of the record
-- Grain: operator, tail, pack, component. Reads: unobserved_units,
-- health_parameters, flights, legs, component_legs, tables.features.
create or replace view missing_estimates as
with last_seen as (
    select
        h.operator,
        h.tail,
        h.pack,
        h.component,
        max(h.departed_at) filter (where h.is_observed) as seen_at
    from health_parameters as h
    where h.component in ('HX', 'CC')
    group by h.operator, h.tail, h.pack, h.component
),

unseen as (
    select
        s.operator,
        s.tail,
        s.pack,
        s.component,
        min(f.departed_at) as counts_from
    from last_seen as s
    inner join flights as f
        on s.operator = f.operator and s.tail = f.tail and s.seen_at < f.departed_at
    group by s.operator, s.tail, s.pack, s.component
    having count(*) >= 15
),

unobserved as (
    select
        operator,
        tail,
        pack,
        component,
        counts_from
    from unobserved_units
    where counts_to is null
    union all
    select n.*
    from unseen as n
    left join unobserved_units as u
        on
            n.operator = u.operator
            and n.tail = u.tail
            and n.pack = u.pack
            and n.component = u.component
            and u.counts_to is null
    where u.operator is null
),

every_leg as (
    select
        operator,
        tail,
        pack,
        departed_at,
        reason,
        null as component
    from legs
    union all
    select
        operator,
        tail,
        pack,
        departed_at,
        reason,
        component
    from component_legs
),

of_unit as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        u.counts_from,
        count(l.departed_at) as n_legs,
        min(l.departed_at) as since,
        mode(l.reason) filter (where l.reason <> '') as reason
    from unobserved as u
    left join every_leg as l
        on
            u.operator = l.operator
            and u.tail = l.tail
            and u.pack = l.pack
            and (u.component = l.component or (l.component is null and u.component in ('HX', 'CC')))
            and coalesce(u.counts_from, '-infinity') <= l.departed_at
    group by u.operator, u.tail, u.pack, u.component, u.counts_from
),

without_rows as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        count(*) as n_flights,
        min(f.departed_at) as since
    from of_unit as u
    inner join flights as f
        on u.operator = f.operator and u.tail = f.tail and u.counts_from <= f.departed_at
    where u.n_legs = 0 and u.component in ('HX', 'CC')
    group by u.operator, u.tail, u.pack, u.component
),

flown as (
    select
        operator,
        tail,
        pack,
        component,
        n_legs as n_flights,
        since,
        reason
    from of_unit
    where n_legs > 0
    union all
    select
        *,
        'NO_ROWS' as reason
    from without_rows
),

lost as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        concat_ws(
            ', ',
            case when median(f.altitude_m_lost_share) >= 0.9 then 'altitude_ft' end,
            case when median(f.mach_lost_share) >= 0.9 then 'mach' end,
            case when median(f.tat_k_lost_share) >= 0.9 then 'tat_degc' end,
            case when median(f.hx_in_k_lost_share) >= 0.9 then 'hx_in_degc' end,
            case when median(f.hx_out_k_lost_share) >= 0.9 then 'hx_out_degc' end,
            case when median(f.pack_flow_kg_s_lost_share) >= 0.9 then 'pack_flow_lbpm' end
        ) as columns
    from unobserved as u
    inner join tables.features as f
        on
            u.operator = f.operator
            and u.tail = f.tail
            and u.pack = f.pack
            and coalesce(u.counts_from, '-infinity') <= f.departed_at
    where u.component = 'HX'
    group by u.operator, u.tail, u.pack, u.component
)

select
    f.*,
    nullif(l.columns, '') as columns
from flown as f
left join lost as l
    on f.operator = l.operator and f.tail = l.tail and f.pack = l.pack and f.component = l.component;
