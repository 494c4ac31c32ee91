-- What was rejected, and why?
-- Grain: rejected file, row or value; computed row; tail that flies for two operators on the same days; channel that a
-- recorder delivers otherwise than one reading a row, with the first file of it.
-- Reads: tables.raw_quarantine, tables.raw_records_quarantine, tables.raw_files_quarantine, tables.raw_flights,
-- tables.raw_components_quarantine, tables.raw_deliveries, recorder_channels.
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
),

files as (
    select
        operator,
        tail,
        flight_id,
        min(file) as file
    from tables.raw_deliveries
    where loaded > 0
    group by operator, tail, flight_id
),

channels as (
    select
        f.file,
        c.reason,
        'note' as scope,
        c.operator,
        c.tail,
        c.since_flight_id as flight_id,
        c.signal as column_name,
        0::bigint as n_rows,
        'Pack ' || c.pack || ' in ' || c.source || ', from this flight to ' || c.until_flight_id || ', in '
        || c.n_flights || ' flights.' as detail
    from recorder_channels as c
    inner join files as f
        on c.operator = f.operator and c.tail = f.tail and c.since_flight_id = f.flight_id
)

select * from tables.raw_quarantine
union all by name
select * from tables.raw_records_quarantine
union all by name
select * from tables.raw_files_quarantine
union all by name
select * from tables.raw_components_quarantine
union all by name
select * from shared
union all by name
select * from channels;
