-- What did the aircraft's printed reports say of bleed and packs?
-- Of reports that say it above 15,000 ft that a bleed or a pack was off or the cross-feed open, no leg is nominal.
-- Grain: operator, tail, reported_at, report. Reads: tables.raw_reports.
create or replace view reports as
select * exclude (file_version)
from tables.raw_reports;
