-- How is each pack now, after each flight?
-- A row uses its flight and those before it. One parameter does not: hx_fouling_smoothed also knows the 50 to 100
-- flights after, changes while they come in, and is for looking back; decide by hx_fouling.
-- Grain: flight, pack, parameter. Reads: tables.twin_health.
create or replace view health_parameters as
select * from tables.twin_health;
