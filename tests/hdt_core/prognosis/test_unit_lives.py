"""A life ends by the message that led to its removal, and by nothing else."""

import polars as pl

from hdt_core.prognosis.unit_lives import episodes, flight_rows, told_lives, with_lives


def test_failed_lives_end_on_the_message_flight(fleet):
    features, messages, maintenance = fleet
    lives = episodes(features, messages, maintenance).filter(pl.col("component") == "HX")
    assert messages.height > 5
    assert lives["failed"].sum() == messages.height
    ended = lives.filter("failed").join(messages.select("tail", "pack", "flight_id"), on=["tail", "pack"])
    flights = features.sort("departed_at").with_columns(end_row=pl.int_range(pl.len()).over("tail", "pack"))
    found = ended.join(flights, on=["tail", "pack", "flight_id", "end_row"])
    assert found.height == messages.height


def test_a_replacement_without_a_message_is_censored(fleet):
    features, messages, maintenance = fleet
    lives = episodes(features, messages.clear(), maintenance).filter(pl.col("component") == "HX")
    assert not lives["failed"].any()
    assert lives.height == 16 + maintenance.height


def test_a_message_after_which_the_unit_was_found_sound_is_no_failure(fleet):
    features, messages, maintenance = fleet
    sound = maintenance.with_columns(
        finding=pl.lit("NO_FAULT_FOUND"), action=pl.lit("INSPECTED"), done_on=pl.col("done_on").dt.offset_by("1d")
    )
    lives = episodes(features, messages, pl.concat([maintenance, sound])).filter(pl.col("component") == "HX")
    assert not lives["failed"].any()


def test_lives_of_a_pack_follow_each_other(fleet):
    lives = episodes(*fleet).filter(pl.col("component") == "HX").sort("tail", "pack", "life")
    following = lives.with_columns(before=pl.col("end_row").shift(1).over("tail", "pack")).drop_nulls("before")
    assert (following["first_row"] >= following["before"]).all()


def test_a_life_is_told_with_what_ended_it(fleet):
    features, messages, maintenance = fleet
    told = told_lives(features, episodes(*fleet)).filter(component="HX")
    named = messages.select("tail", "pack", end_flight_id="flight_id")
    assert told.filter(ended_by="message").join(named, on=named.columns, how="semi").height == messages.height
    assert told.filter(pl.col("censored") == pl.col("ended_by").eq_missing(pl.lit("message"))).is_empty()
    unheard = told_lives(features, episodes(features, messages.clear(), maintenance)).filter(component="HX")
    assert unheard.filter(ended_by="unheard").height == maintenance.height
    assert unheard["ended_by"].null_count() == 16


def test_each_flight_is_flown_by_the_unit_that_came_last(fleet):
    features, lives = fleet[0], episodes(*fleet)
    own = lives.filter(component="HX")
    by_pack = {key: part.rows(named=True) for key, part in own.partition_by("tail", "pack", as_dict=True).items()}
    flown = with_lives(flight_rows(features), lives, "HX")
    assert flown.height == features.height
    for flight in flown.sample(500, seed=3).iter_rows(named=True):
        life = max(
            (x for x in by_pack[flight["tail"], flight["pack"]] if x["first_row"] <= flight["row"]),
            key=lambda x: x["first_row"],
        )
        assert (flight["life"], flight["left"]) == (life["life"], life["end_row"] - flight["row"])
