-- Does every refused leg say why?
-- A fault: a leg refused without a reason, admitted with one, or with more nominal samples than samples. Reads: legs.
select
    operator,
    tail,
    flight_id,
    pack,
    admitted,
    reason,
    n_samples,
    n_nominal
from legs
where
    admitted <> (reason = '')
    or n_nominal > n_samples
    or (admitted and n_nominal = 0);
