-- How far are sensor, model and twin apart?
-- Grain: flight, pack, signal, kind. Reads: tables.residuals.
create or replace view residuals as
select * from tables.residuals;
