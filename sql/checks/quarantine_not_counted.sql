-- Does the quarantine hold the rows that the files' accounts say it does?
-- A fault: a file whose rows in quarantine are not the number its account gives. Reads: quarantine, deliveries.
with held as (
    select
        file,
        sum(n_rows)::bigint as held
    from quarantine
    group by file
)

select
    coalesce(d.file, h.file) as file,
    d.quarantined,
    h.held
from deliveries as d
full join held as h on d.file = h.file
where coalesce(d.quarantined, 0) <> coalesce(h.held, 0);
