-- Does every design parameter have a value, and one that can be?
-- A fault: a design parameter without value or unit, with a negative standard deviation, of no known scope, or of a
-- scope that its operator, tail and pack do not fit. Reads: design_parameters.
select
    scope,
    operator,
    tail,
    pack,
    component,
    parameter,
    value,
    sd
from design_parameters
where
    value is null
    or sd < 0
    or coalesce(unit, '') = ''
    or scope not in ('fleet', 'operator', 'tail')
    or (scope = 'fleet') <> (operator is null)
    or (scope = 'tail') <> (tail is not null);
