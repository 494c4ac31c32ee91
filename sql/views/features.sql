-- What is known of each pack after each flight, one column a feature?
-- Grain: flight, pack. Reads: tables.features.
create or replace view features as
select * from tables.features;
