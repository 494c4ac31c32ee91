-- What does the loss of each declared component show, flight by flight?
-- departed_on: day of departure in UTC; departed_at::date is a day of the session's time zone
-- Grain: flight, pack, component. Reads: tables.features_components.
create or replace view component_features as
select
    *,
    (departed_at at time zone 'UTC')::date as departed_on
from tables.features_components;
