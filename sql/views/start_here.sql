-- Which views answer the first questions?
-- place: order in which to read them
-- question: what the view answers
-- view_name: its name
-- Grain: place.
create or replace view start_here as
select questions.*
from (
    values
    (1, 'which pack first tonight?', 'fleet_ranking'),
    (2, 'why?', 'open_alerts'),
    (3, 'how long is left, how sure?', 'prognoses'),
    (4, 'wash, replace or wait, at what cost?', 'next_stop'),
    (5, 'how has it worn?', 'health_parameters'),
    (6, 'were the alerts right?', 'alert_outcomes')
) as questions (place, question, view_name);
