-- How far are sensor, model and twin apart?
-- Grain: flight, pack, signal, kind. Reads: tables.residuals, tables.residuals_components.
create or replace view residuals as
select * from tables.residuals
union all by name
select * from tables.residuals_components;
