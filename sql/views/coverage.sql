-- What can be estimated of each aircraft that has a type, and what is missing for the rest?
-- Aircraft whose files are the default record are not here: what they do not record has the status not_recorded in
-- health_parameters.
-- Grain: operator, tail, component, parameter. Reads: tables.raw_coverage.
create or replace view coverage as
select * from tables.raw_coverage;
