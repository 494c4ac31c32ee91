-- Which columns of which aircraft are refused wholesale, up to the last file that came, and since when?
-- folder: folder of the aircraft that holds the files
-- column_name: column at fault; null where whole files are
-- since_flight: day and leg of the first flight in a row that is refused
-- until_flight: day and leg of the last
-- n_files: files of these flights
-- file: the last of them
-- n_refused: values refused, or rows where rows are
-- n_delivered: rows in these files
-- fits: unit in which the values would make sense, where one is known
-- Grain: operator, tail, folder, column_name, reason. Reads: tables.raw_quarantine,
-- tables.raw_deliveries.
create or replace view silent_columns as
with files as (
    select
        operator,
        tail,
        split_part(file, '/', 3) as folder,
        file,
        min(right(flight_id, 11)) as first_flight,
        max(right(flight_id, 11)) as last_flight,
        sum(delivered) as delivered
    from tables.raw_deliveries
    group by operator, tail, folder, file
),

refused as (
    select
        file,
        reason,
        case when scope = 'value' then column_name end as of_column,
        any_value(column_name) as column_name,
        sum(
            case
                when scope = 'value'
                    then coalesce(try_cast(regexp_extract(detail, 'And (\d+) more values', 1) as bigint), 1)
                else n_rows
            end
        ) as n_refused,
        max(nullif(regexp_extract(detail, 'It fits ([^.]+)', 1), '')) as fits
    from tables.raw_quarantine
    -- what lost to a better delivery is no silence; and of two packs one is half of the rows
    where scope in ('file', 'row', 'value') and reason not in ('conflicting_delivery', 'replaced_row')
    group by file, reason, of_column
),

silent as (
    select
        f.*,
        r.reason,
        r.of_column,
        r.column_name,
        r.n_refused,
        r.fits
    from refused as r
    inner join files as f on r.file = f.file
    where f.delivered > 0 and r.n_refused > 0 and r.n_refused >= 0.4 * f.delivered
),

columns_silent as (
    select distinct
        operator,
        tail,
        folder,
        reason,
        of_column
    from silent
),

sound as (
    select
        a.operator,
        a.tail,
        a.folder,
        a.reason,
        a.of_column,
        max(f.last_flight) as last_flight
    from columns_silent as a
    inner join files as f on a.operator = f.operator and a.tail = f.tail and a.folder = f.folder
    left join silent as s
        on f.file = s.file and a.reason = s.reason and coalesce(a.of_column, '') = coalesce(s.of_column, '')
    where s.file is null
    group by a.operator, a.tail, a.folder, a.reason, a.of_column
)

select
    s.operator,
    s.tail,
    s.folder,
    any_value(s.column_name) as column_name,
    s.reason,
    min(s.first_flight) as since_flight,
    max(s.last_flight) as until_flight,
    count(*) as n_files,
    arg_max(s.file, s.last_flight) as file,
    sum(s.n_refused)::bigint as n_refused,
    sum(s.delivered)::bigint as n_delivered,
    max(s.fits) as fits
from silent as s
left join sound as g
    on
        s.operator = g.operator and s.tail = g.tail and s.folder = g.folder and s.reason = g.reason
        and coalesce(s.of_column, '') = coalesce(g.of_column, '')
where g.last_flight is null or s.last_flight > g.last_flight
group by s.operator, s.tail, s.folder, s.reason, s.of_column;
