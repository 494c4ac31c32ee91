"""Tables of stage prognosis: models, predictions and lives."""

import dataframely as dy

from hdt_core.tables.base import (
    AircraftTable,
    ComponentLegTable,
    Table,
    column,
    component_key,
    count,
    flag,
    moment,
    number,
    pack_key,
    text,
)  # fmt: skip


def _chance_within(flights: int) -> dy.Float64:
    return number(f"probability of a failure event within the next {flights} flights", "-", 0, 1)


class PrognosisBase(Table):
    """Prognostic model learned from simulated lives, before any fleet's."""

    model_version = text("digest of the base", nullable=False, primary_key=True)
    card = text("model card as JSON", nullable=False)
    model = column(dy.Binary, "the base as skops bytes")


class PrognosisModel(Table):
    """The prognostic model of a month: the base, corrected by the record as the month began."""

    month = column(dy.Date, "first day of the month whose flights it scores", primary_key=True)
    model_version = text("digest of the base and of what it learned from", nullable=False)
    card = text("model card as JSON; of the newest month with the scores of all flights before it", nullable=False)
    service = text("why it learned, and why its base serves, as JSON", nullable=False)
    fits = text("corrections learned from the fleet's lives, by component and fold, as JSON", nullable=False)
    training_digest = text(
        "what it learned from, as JSON: base, models of the aircraft, tails, ended lives, flights of each pack",
        nullable=False,
    )
    scored_flights = text(
        "by component and pack, the flights of the month that have a prognosis, and a hash of their health, as JSON",
        nullable=False,
    )
    model = column(dy.Binary, "the base of all months as skops bytes, in the newest month's row", nullable=True)


class Prognoses(ComponentLegTable):
    """Predicted remaining life after a flight: flight, pack, component."""

    component = component_key()
    departed_at = moment("first recorded time")
    rul_flights = number("flights left until the failure message, 50 % point without any condition", "flights", 0)
    rul_low = number("5 % point of the flights left; 300 stands for 300 or more", "flights", 0)
    rul_high = number("95 % point of the flights left; 300 stands for 300 or more", "flights", 0)
    p_event_25 = _chance_within(25)
    p_event_50 = _chance_within(50)
    p_event_100 = _chance_within(100)
    p_event_200 = _chance_within(200)
    p_event_300 = _chance_within(300)
    beyond_horizon = flag("rul_flights lies beyond the horizon of 300 flights", nullable=True)
    model_version = text("model of the prediction", nullable=False)
    split = text("out_of_fold or live", nullable=False)


class PrognosisChoices(ComponentLegTable):
    """Forecast after a unit's last flight from the loss that a choice leaves: pack, component, choice."""

    component = component_key()
    choice = text("defer (no work), wash or replace", nullable=False, primary_key=True)
    departed_at = moment("first recorded time")
    loss_left = number("loss after it, the mean of what it may leave", "-")
    loss_left_sd = number("spread of what it may leave", "-", 0)
    rests_on = text(
        "what the share rests on that a wash leaves: prior, or the number of washes after like losses and findings"
    )
    p_event_25 = _chance_within(25)
    p_event_50 = _chance_within(50)
    p_event_100 = _chance_within(100)
    p_event_200 = _chance_within(200)
    p_event_300 = _chance_within(300)


class PrognosisLives(AircraftTable):
    """One life of a unit, from its first flight on record to the event that ended it, or to the last flight."""

    pack = pack_key()
    component = component_key()
    life = column(dy.Int64, "number of the unit in that place, 0 where the record begins with it", primary_key=True)
    ended_by = text(
        "message (one that a replacement answered: a failure), replaced (without one), unheard (replaced, of an "
        "operator that delivers no messages); null while the unit flies"
    )
    censored = flag("the life was cut short, or goes on: how long it would have lasted is not known")
    n_flights = count("flights from the first on record to the end", "flights")
    age_known = flag("the unit was new at its first flight on record")
    first_row = count("number of its first flight among the pack's, from 0")
    end_row = count("number of the message's flight, or of the flight after the unit's last")
    first_flight_id = text("its first flight on record")
    first_departed_at = moment("departure of that flight", nullable=True)
    end_flight_id = text("flight of the message, else its last flight")
    end_departed_at = moment("departure of that flight", nullable=True)
