-- What is known of each pack after each flight, one column a feature?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight, pack. Reads: tables.features, airframes.
create or replace view features as
select
    o.*,
    (o.departed_at at time zone 'UTC')::date as departed_on,
    n.msn
from tables.features as o
left join airframes as n on o.operator = n.operator and o.tail = n.tail;
