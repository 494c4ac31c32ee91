-- Was a delivered row lost, or counted twice?
-- A fault: a file whose delivered rows are not its loaded, quarantined and duplicate rows. Reads: deliveries.
select
    file,
    delivered,
    loaded,
    quarantined,
    duplicate,
    delivered - loaded - quarantined - duplicate as lost
from deliveries
where delivered is distinct from loaded + quarantined + duplicate;
