-- How long is left, and how sure?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- status: ok; contradicted (the component was found clean since, and not renewed: what the sensors say, which an
-- inspection did not see); prior_only (no flight of the unit was informative: the prior of any unit)
-- Grain: flight, pack, component. Reads: airframes, alerts, unobserved_units, tables.prognoses, settled_work.
create or replace view prognoses as
with findings as (
    select
        operator,
        tail,
        pack,
        component,
        closed_at as counts_from,
        'contradicted' as status
    from alerts
    where closed_reason = 'found_clean' and diagnosis != 'HX_LOW_MARGIN'
    union all
    select
        operator,
        tail,
        pack,
        component,
        counts_from,
        'ok' as status
    from settled_work
    where action in ('REPLACED', 'CLEANED') and pack is not null
),

statuses as (
    select
        operator,
        tail,
        pack,
        component,
        counts_from,
        min(status) as status
    from findings
    group by operator, tail, pack, component, counts_from
),

spells as (
    select
        operator,
        tail,
        pack,
        component,
        status,
        counts_from,
        coalesce(
            lead(counts_from) over (partition by operator, tail, pack, component order by counts_from), 'infinity'
        ) as counts_to
    from statuses
),

contradicted as (
    select *
    from spells
    where status = 'contradicted'
)

select
    o.*,
    (o.departed_at at time zone 'UTC')::date as departed_on,
    case
        when u.component is not null then 'prior_only'
        else coalesce(c.status, 'ok')
    end as status,
    n.msn
from tables.prognoses as o
left join airframes as n on o.operator = n.operator and o.tail = n.tail
left join unobserved_units as u
    on
        o.operator = u.operator
        and o.tail = u.tail
        and o.pack = u.pack
        and o.component = u.component
        and o.departed_at >= coalesce(u.counts_from, '-infinity')
        and o.departed_at < coalesce(u.counts_to, 'infinity')
left join contradicted as c -- few rows, so that no prognosis need be sorted
    on
        o.operator = c.operator
        and o.tail = c.tail
        and o.pack = c.pack
        and o.component = c.component
        and o.departed_at >= c.counts_from
        and o.departed_at < c.counts_to;
