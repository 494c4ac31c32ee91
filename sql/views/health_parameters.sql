-- How is each pack now, after each flight?
-- Grain: flight, pack, parameter. Reads: tables.twin_health.
create or replace view health_parameters as
select * from tables.twin_health;
