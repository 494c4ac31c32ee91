-- How long did each unit fly, and what ended its life?
-- The definition of an event that the prognosis learns from and is judged by: a message of the component that a
-- replacement answered within twenty flights, unless somebody found the unit sound in between.
-- Grain: operator, tail, pack, component, life. Reads: tables.prognosis_lives.
create or replace view unit_lives as
select * from tables.prognosis_lives;
