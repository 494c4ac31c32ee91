-- Of which units was nothing seen beyond the prior, and for how long?
-- Beyond the prior is an estimate once its standard deviation is a third of the prior's, or five flights have moved it;
-- flights of few samples move it only where half of those flown did: a handful of rows on some of them is no knowledge.
-- counts_from: since when the unit is fitted by the log of work; NULL where that was before the first entry
-- counts_to: departure of the first flight after which its loss is so known, or since when the next unit is fitted;
-- NULL where nothing is seen tonight
-- Grain: operator, tail, pack, component, counts_from. Reads: health_parameters, tables.components,
-- settled_work.
create or replace view unobserved_units as
with estimates as (
    select
        h.operator,
        h.tail,
        h.pack,
        h.component,
        h.departed_at,
        h.flight_id,
        h.is_observed,
        h.is_observed and h.status != 'few_samples' as is_well_observed,
        3 * h.sd <= c.prior_sd as is_sure
    from health_parameters as h
    left join tables.components as c on h.component = c.component
    where h.parameter = c.loss or h.parameter = 'cc_diameter_loss'
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
    from settled_work
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

flown as (
    select
        u.*,
        e.departed_at,
        e.is_observed,
        e.is_sure,
        count(*) filter (where e.is_observed) over unit_flights as n_observed,
        count(*) filter (where e.is_well_observed) over unit_flights as n_well_observed,
        count(*) over unit_flights as n_flown
    from units as u
    inner join estimates as e
        on
            u.operator = e.operator
            and u.tail = e.tail
            and u.pack = e.pack
            and u.component = e.component
            and u.counts_from <= e.departed_at
            and u.ended_at > e.departed_at
    window
        unit_flights as (
            partition by u.operator, u.tail, u.pack, u.component, u.counts_from order by e.departed_at, e.flight_id
        )
),

judged as (
    select
        *,
        coalesce(is_sure, true)
        or n_well_observed >= 5
        or (n_observed >= 5 and 2 * n_observed >= n_flown) as is_known
    from flown
),

observed as (
    select
        u.operator,
        u.tail,
        u.pack,
        u.component,
        u.counts_from,
        coalesce(
            min(u.departed_at) filter (where u.is_observed and u.is_known),
            u.ended_at
        ) as counts_to,
        min(u.departed_at) as first_departed_at
    from judged as u
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
