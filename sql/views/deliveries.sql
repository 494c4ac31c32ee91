-- Where did the delivered rows of each file go? delivered = loaded + quarantined + duplicate
-- Grain: file. Reads: tables.raw_deliveries, tables.raw_records_deliveries, tables.raw_files_deliveries,
-- tables.raw_components_deliveries.
create or replace view deliveries as
with entries as (
    select * from tables.raw_deliveries
    union all by name
    select * from tables.raw_records_deliveries
    union all by name
    select * from tables.raw_files_deliveries
    union all by name
    select * from tables.raw_components_deliveries
)

select
    file,
    sum(delivered)::bigint as delivered,
    sum(loaded)::bigint as loaded,
    sum(quarantined)::bigint as quarantined,
    sum(duplicate)::bigint as duplicate
from entries
group by file;
