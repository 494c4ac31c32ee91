-- What is known of each pack after each flight, one column a feature?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight, pack. Reads: tables.features.
create or replace view features as
select
    *,
    (departed_at at time zone 'UTC')::date as departed_on
from tables.features;
