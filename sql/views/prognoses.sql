-- How long is left, and how sure?
-- Grain: flight, pack, component. Reads: tables.prognoses.
create or replace view prognoses as
select * from tables.prognoses;
