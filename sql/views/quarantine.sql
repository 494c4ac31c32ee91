-- What was rejected, and why?
-- Grain: rejected file, row or value; computed row; tail that flies for two operators on the same days.
-- Reads: tables.raw_quarantine, tables.raw_records_quarantine, tables.raw_files_quarantine, tables.raw_flights,
-- tables.raw_components_quarantine.
create or replace view quarantine as
with spans as (
    select
        operator,
        tail,
        min(departed_at) as since,
        max(departed_at) as until
    from tables.raw_flights
    group by operator, tail
),

shared as (
    select
        a.operator || '/' || a.tail as file,
        'tail_of_two_operators' as reason,
        'note' as scope,
        a.operator,
        a.tail,
        a.until as received_at,
        0::bigint as n_rows,
        'The same tail flies for two operators on the same days. '
        || b.operator || ' delivers flights of it from ' || strftime(b.since, '%Y-%m-%d')
        || ' to ' || strftime(b.until, '%Y-%m-%d') || '.' as detail
    from spans as a
    inner join spans as b
        on a.tail = b.tail and a.operator != b.operator and a.since <= b.until and a.until >= b.since
)

select * from tables.raw_quarantine
union all by name
select * from tables.raw_records_quarantine
union all by name
select * from tables.raw_files_quarantine
union all by name
select * from tables.raw_components_quarantine
union all by name
select * from shared;
