-- What does each status in health_parameters mean, and what can be behind it?
-- status: as in health_parameters
-- meaning: what it says of the estimate
-- causes: what can be behind it, and what to do; null where there is nothing to do
-- Grain: status. Reads: health_parameters.
create or replace view statuses as
with explained as (
    select
        v.status,
        v.meaning,
        v.causes
    from (
        values
        ('ok', 'the flight moved the estimate', null),
        ('sensor_corrected', 'a sensor that other signals contradict was taken out first', null),
        ('predicted', 'the flight said nothing; the estimate is that of the flights before, or the prior', null),
        (
            'prior_only',
            'too few flights have calibrated the unit: the declared prior carries the estimate',
            'some ten steady flights of the part as built calibrate it'
        ),
        ('not_identifiable', 'the flight does not determine it', null),
        (
            'diverged',
            'the component''s method found no estimate on the flight',
            'another method in the home''s estimators.toml'
        ),
        (
            'not_recorded',
            'a signal that it needs is not recorded',
            'compare the files with `hdt docs raw-data`; the view coverage lists what aircraft with a type lack'
        ),
        ('measured', 'a reading of the recorder, without a model', null),
        ('off_nominal', 'the flight has no usable sample of the reading', null),
        ('few_samples', 'too few samples', null),
        ('no_cruise', 'the flight has no level cruise', null),
        ('implausible', 'the flight shows what no exchanger can', null),
        ('no_number', 'the estimate came out as no number', null),
        (
            'one_or_more',
            'a tenth of the samples or more show a share above one: no fault, and no alert comes of it',
            'water sprayed at the ram inlet (hdt terms --accept water_spray); a sensor that sits elsewhere than its '
            || 'name says; another meaning of the parameter; a ground fan, or air of another source than TAT shows, '
            || 'in the ram duct; a sensor that is off'
        )
    ) as v (status, meaning, causes)
)

select
    e.status,
    e.meaning,
    e.causes
from explained as e
semi join health_parameters as h on e.status = h.status;
