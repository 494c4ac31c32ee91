-- How were the aircraft built, as far as their nominal flights say?
-- Grain: scope, operator, tail, pack, component, parameter. Reads: tables.calibration_design,
-- tables.calibration_components.
create or replace view design_parameters as
select * from tables.calibration_design
union all by name
select * from tables.calibration_components;
