-- Of which units was nothing seen beyond the prior, and for how long?
-- counts_from: since when the unit is fitted by the log of work; NULL where that was before the first entry
-- counts_to: departure of the first flight that moved the estimate of its loss, or since when the next unit is fitted;
-- NULL where nothing is seen tonight
-- Grain: operator, tail, pack, component, counts_from. Reads: health_parameters, tables.components,
-- tables.raw_maintenance.
create or replace view unobserved_units as
with estimates as (
    select
        operator,
        tail,
        pack,
        component,
        departed_at,
        is_observed
    from health_parameters
    where parameter in (select c.loss from tables.components as c) or parameter = 'cc_diameter_loss'
),

entries as (
    select distinct
        operator,
        tail,
        pack,
        component,
        '-infinity'::timestamptz as counts_from
    from estimates
    union
    select
        operator,
        tail,
        pack,
        component,
        counts_from
    from tables.raw_maintenance
    where action = 'REPLACED' and pack is not null
),

units as (
    select
        *,
        coalesce(
            lead(counts_from) over (partition by operator, tail, pack, component order by counts_from), 'infinity'
        ) as ended_at
    from entries
),

observed as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        u.counts_from,
        coalesce(min(e.departed_at) filter (where e.is_observed), u.ended_at) as counts_to,
        min(e.departed_at) as first_departed_at
    from units as u
    inner join estimates as e
        on
            u.operator = e.operator
            and u.tail = e.tail
            and u.pack = e.pack
            and u.component = e.component
            and u.counts_from <= e.departed_at
            and u.ended_at > e.departed_at
    group by u.operator, u.tail, u.pack, u.component, u.counts_from, u.ended_at
)

select
    operator,
    tail,
    pack,
    component,
    nullif(counts_from, '-infinity') as counts_from,
    nullif(counts_to, 'infinity') as counts_to
from observed
where first_departed_at < counts_to;
