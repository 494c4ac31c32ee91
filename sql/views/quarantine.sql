-- What was rejected, and why?
-- Grain: rejected file, row or value; computed row; tail that flies for two operators on the same days; channel that a
-- recorder delivers otherwise than one reading a row, with the first file of it;
-- name of an airframe with flights before its delivery, or on days on which no line of fleet.csv holds; aircraft of
-- planned checks that nobody knows.
-- Reads: tables.raw_quarantine, tables.raw_records_quarantine, tables.raw_files_quarantine, tables.raw_flights,
-- tables.raw_components_quarantine, tables.raw_deliveries, tables.raw_checks, recorder_channels, aircraft.
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
        'Pack ' || c.pack || ' in ' || c.source || ', on this flight and up to ' || c.until_flight_id || ', in '
        || c.n_flights || ' flights.' as detail
    from recorder_channels as c
    inner join files as f
        on c.operator = f.operator and c.tail = f.tail and c.since_flight_id = f.flight_id
),

listed_flights as (
    select
        a.airframe_operator as operator,
        a.airframe_tail as tail,
        a.operator || '/' || a.tail as file,
        f.departed_at,
        min(a.delivered_on) as delivered_on,
        bool_or(
            (f.departed_at at time zone 'UTC')::date between coalesce(a.valid_from, '-infinity')
            and coalesce(a.valid_to, 'infinity')
        ) as is_valid
    from tables.raw_flights as f
    inner join aircraft as a
        on
            f.operator = a.airframe_operator
            and f.tail = a.airframe_tail
            and f.flight_id[:-13] = a.flight_prefix || a.tail
    group by a.airframe_operator, a.airframe_tail, a.operator, a.tail, f.flight_id, f.departed_at
),

outside as (
    select
        *,
        'flights_outside_line' as reason,
        'on days on which no line of fleet.csv holds.' as words
    from listed_flights
    where not is_valid
    union all
    select
        *,
        'flights_before_delivery' as reason,
        'before the delivery on ' || delivered_on || '.' as words
    from listed_flights
    where (departed_at at time zone 'UTC')::date < delivered_on
),

notes as (
    select
        file,
        reason,
        'note' as scope,
        operator,
        tail,
        max(departed_at) as received_at,
        0::bigint as n_rows,
        count(*) || ' flights from ' || strftime(min(departed_at), '%Y-%m-%d') || ' to '
        || strftime(max(departed_at), '%Y-%m-%d') || ' ' || words as detail
    from outside
    group by file, reason, operator, tail, words
),

unknown_checks as (
    select
        'checks.csv' as file,
        'unknown_tail' as reason,
        'note' as scope,
        c.operator,
        c.tail,
        0::bigint as n_rows,
        count(*) || ' checks of ' || c.operator || ' ' || c.tail
        || ', which has no flight and no line in fleet.csv: they count for none.' as detail
    from tables.raw_checks as c
    where
        (c.operator, c.tail) not in (
            select (a.operator, a.tail)
            from aircraft as a
        )
        and (c.operator, c.tail) not in (
            select (f.operator, f.tail)
            from tables.raw_flights as f
        )
    group by c.operator, c.tail
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
select * from channels
union all by name
select * from notes
union all by name
select * from unknown_checks;
