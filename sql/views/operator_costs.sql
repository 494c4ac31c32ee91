-- What did each operator's messages, removals and washes cost, and what is to be expected?
-- Events at the figures of costs.toml; components without a figure are left out, and those that the operator's flights
-- and log do not show. All work has the cost of a stop; delays and spares are in no log.
-- n_flights: flights of the operator's aircraft
-- n_messages: units whose message came; its repeats until the work count once
-- n_removals: replacements
-- n_washes: washes
-- n_needless: replacements and washes that found no fault
-- messages_cost: n_messages at the cost of one [currency]
-- removals_cost: likewise [currency]
-- washes_cost: likewise [currency]
-- total_cost: the three together [currency]
-- cost_per_1000_flights: total_cost for a thousand flights [currency]
-- saving_at_most: as in realised_savings [currency]
-- saving_expected: as in realised_savings [currency]
-- expected_message_cost: of messages before the next chance to act, as in unit_urgencies [currency]
-- cost_source: costs.toml, or default where a figure of the row is a round one of ours
-- Grain: operator, component. Reads: flights, health_parameters, removal_leads, realised_savings, unit_urgencies,
-- tables.raw_costs.
create or replace view operator_costs as
with prices as (
    select
        component,
        any_value(cost) filter (where item = 'message') as message_price,
        any_value(cost) filter (where item = 'replace') as removal_price,
        any_value(cost) filter (where item = 'wash') as wash_price,
        any_value(currency) as currency,
        max(source) filter (where item != 'at_check') as cost_source
    from tables.raw_costs
    group by component
),

flown as (
    select
        operator,
        count(*) as n_flights
    from flights
    group by operator
),

fitted as (
    select operator, component from health_parameters -- noqa: LT09
    union
    select operator, component from removal_leads -- noqa: LT09
),

happened as (
    select
        operator,
        component,
        count(first_message_at) as n_messages,
        count(*) filter (where work_action = 'REPLACED') as n_removals,
        count(*) filter (where work_action = 'CLEANED') as n_washes,
        count(*) filter (where work_finding = 'NO_FAULT_FOUND') as n_needless
    from removal_leads
    group by operator, component
),

saved as (
    select
        operator,
        component,
        sum(saving_at_most) as saving_at_most,
        sum(saving_expected) as saving_expected
    from realised_savings
    group by operator, component
),

expected as (
    select
        operator,
        component,
        sum(message_cost) as expected_message_cost
    from unit_urgencies
    group by operator, component
),

counted as (
    select
        f.operator,
        p.component,
        f.n_flights,
        p.message_price,
        p.removal_price,
        p.wash_price,
        p.currency,
        p.cost_source,
        coalesce(h.n_messages, 0) as n_messages,
        coalesce(h.n_removals, 0) as n_removals,
        coalesce(h.n_washes, 0) as n_washes,
        coalesce(h.n_needless, 0) as n_needless
    from flown as f
    inner join fitted as c on f.operator = c.operator
    inner join prices as p on c.component = p.component
    left join happened as h on f.operator = h.operator and p.component = h.component
),

priced as (
    select
        *,
        n_messages * message_price as messages_cost,
        n_removals * removal_price as removals_cost,
        case when n_washes = 0 then 0 else n_washes * wash_price end as washes_cost
    from counted
)

select
    p.operator,
    p.component,
    p.n_flights,
    p.n_messages,
    p.n_removals,
    p.n_washes,
    p.n_needless,
    p.messages_cost,
    p.removals_cost,
    p.washes_cost,
    p.messages_cost + p.removals_cost + p.washes_cost as total_cost,
    1000 * total_cost / p.n_flights as cost_per_1000_flights,
    coalesce(s.saving_at_most, 0) as saving_at_most,
    coalesce(s.saving_expected, 0) as saving_expected,
    e.expected_message_cost,
    p.currency,
    p.cost_source
from priced as p
left join saved as s on p.operator = s.operator and p.component = s.component
left join expected as e on p.operator = e.operator and p.component = e.component;
