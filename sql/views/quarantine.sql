-- What was rejected, and why?
-- Grain: rejected file, row or value.
-- Reads: tables.raw_quarantine, tables.raw_records_quarantine, tables.raw_files_quarantine.
create or replace view quarantine as
select * from tables.raw_quarantine
union all by name
select * from tables.raw_records_quarantine
union all by name
select * from tables.raw_files_quarantine;
