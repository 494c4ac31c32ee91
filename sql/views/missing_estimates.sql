-- What is missing where nothing is seen of a unit tonight?
-- n_flights: its flights so far, none of which moved the estimate
-- since: departure of the first of them
-- reason: why most of their legs were not admitted; a code, as in legs
-- columns: what the exchanger's estimate needs and holds hardly a value in most of these flights, names of the record
-- Grain: operator, tail, pack, component. Reads: unobserved_units, legs, component_legs, tables.features.
create or replace view missing_estimates as
with unobserved as (
    select *
    from unobserved_units
    where counts_to is null
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

flown as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        count(*) as n_flights,
        min(l.departed_at) as since,
        mode(l.reason) filter (where l.reason <> '') as reason
    from unobserved as u
    inner join every_leg as l
        on
            u.operator = l.operator
            and u.tail = l.tail
            and u.pack = l.pack
            and (u.component = l.component or (l.component is null and u.component in ('HX', 'CC')))
            and coalesce(u.counts_from, '-infinity') <= l.departed_at
    group by u.operator, u.tail, u.pack, u.component
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
