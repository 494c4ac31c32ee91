-- What did work after an alert save, by the log and the cost table?
-- One row a spell of removal_leads that had an alert and then work. Whether a message would have come had the unit
-- stayed can't be known: saving_at_most takes it as certain, saving_expected as likely as the prognosis before the
-- work. The cost of the work is not subtracted; delays, spares and consequential damage are in no log.
-- outcome: what came of the alert, as in alert_outcomes
-- p_event_50: chance of a message within 50 flights before the work: median of ten flights, the six before the log's
-- moment left out [-]
-- work_cost: of the replacement or wash at the next stop [currency]
-- message_cost: of one message [currency]
-- saving_at_most: message_cost where the work came before a message and the alert was found or answered; else 0
-- [currency]
-- saving_expected: saving_at_most times p_event_50 [currency]
-- needless_cost: work_cost where no fault was found, else 0 [currency]
-- cost_source: costs.toml, or default where a figure of the row is a round one of ours
-- Grain: operator, tail, pack, component, spell (from 0). Reads: removal_leads, prognoses, tables.raw_costs.
create or replace view realised_savings as
with answered as (
    select *
    from removal_leads
    where flights_to_work is not null
),

placed as (
    select
        a.operator,
        a.tail,
        a.pack,
        a.component,
        a.spell,
        p.p_event_50,
        row_number() over (
            partition by a.operator, a.tail, a.pack, a.component, a.spell order by p.departed_at desc
        ) as n_before
    from answered as a
    inner join prognoses as p
        on
            a.operator = p.operator
            and a.tail = p.tail
            and a.pack = p.pack
            and a.component = p.component
            and a.work_at > p.departed_at
            and coalesce(a.begins_at, '-infinity') <= p.departed_at
),

chances as (
    select
        operator,
        tail,
        pack,
        component,
        spell,
        median(p_event_50) as p_event_50
    from placed
    where n_before between 7 and 16
    group by operator, tail, pack, component, spell
),

priced as (
    select
        a.operator,
        a.tail,
        a.pack,
        a.component,
        a.spell,
        a.alert_id,
        a.diagnosis,
        a.first_raised_at,
        a.work_action,
        a.work_on,
        a.work_finding,
        a.outcome,
        f.p_event_50,
        w.cost as work_cost,
        m.cost as message_cost,
        case
            when a.first_message_at is null and a.outcome in ('found', 'answered') then m.cost else m.cost * 0
        end as saving_at_most,
        case when a.outcome = 'no_fault_found' then w.cost else w.cost * 0 end as needless_cost,
        m.currency,
        greatest(w.source, m.source) as cost_source
    from answered as a
    left join chances as f
        on
            a.operator = f.operator
            and a.tail = f.tail
            and a.pack = f.pack
            and a.component = f.component
            and a.spell = f.spell
    left join tables.raw_costs as m on a.component = m.component and m.item = 'message'
    left join tables.raw_costs as w
        on a.component = w.component and w.item = case when a.work_action = 'CLEANED' then 'wash' else 'replace' end
)

select
    *,
    saving_at_most * p_event_50 as saving_expected
from priced;
