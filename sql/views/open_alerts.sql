-- Which open alerts come first?
-- Packs stand in the order of fleet_ranking, alerts of one pack in that of place_in_pack.
-- pack_place: the pack's place in fleet_ranking
-- place: 1 is the most urgent
-- Grain: alert. Reads: alert_states, fleet_ranking.
create or replace view open_alerts as
select
    a.*,
    r.place as pack_place,
    row_number() over (order by r.place asc nulls last, a.place_in_pack asc, a.raised_at asc, a.alert_id asc) as place
from alert_states as a
left join fleet_ranking as r on a.operator = r.operator and a.tail = r.tail and a.pack = r.pack
where a.closed_at is null;
