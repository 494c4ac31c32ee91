-- What share of legs was fit to calibrate from, by operator, tail and month?
-- month: first day of the month (UTC)
-- n_legs: legs judged, each pack of a flight by itself
-- n_admitted: legs fit to calibrate from
-- admitted_share: n_admitted over n_legs [-]
-- n_fouled: legs refused because the exchanger is worn
-- usual_reason: the commonest reason of those refused
-- Grain: operator, tail, month. Reads: legs.
create or replace view filter_yield as
select
    operator,
    tail,
    date_trunc('month', departed_at at time zone 'UTC')::date as month,
    count(*) as n_legs,
    count(*) filter (where admitted) as n_admitted,
    count(*) filter (where admitted) / count(*) as admitted_share,
    count(*) filter (where reason = 'HX_WORN') as n_fouled,
    mode(reason) filter (where not admitted) as usual_reason
from legs
group by operator, tail, month;
