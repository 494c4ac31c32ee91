"""The catalog as a dashboard for planners and managers: `HDT_HOME=hdt_home streamlit run notebooks/dashboard.py`."""

import os
from pathlib import Path

import altair as alt
import duckdb
import polars as pl
import streamlit as st

CATALOG = Path(os.environ.get("HDT_HOME", "hdt_home")) / "catalog.duckdb"
UNIT = "concat_ws(' ', tail, 'pack', pack, component, work_on)"

st.set_page_config("Fleet", layout="wide")
if not CATALOG.exists():
    st.error(f"No catalog at {CATALOG}: set HDT_HOME to a home that `hdt nightly` has filled.")
    st.stop()


def ask(sql: str, *parameters: object) -> pl.DataFrame:
    """Return the rows of one select; the catalog is opened read only and closed again, so a night can publish."""
    with duckdb.connect(str(CATALOG), read_only=True) as con:
        con.execute("set TimeZone = 'UTC'")
        return con.sql(sql, params=list(parameters)).pl()


def lines(frame: pl.DataFrame, x: str, y: str, title: str, series: str = "operator") -> alt.Chart:
    """Return lines of one column over another, a colour and a mark for each operator."""
    return (
        alt.Chart(frame, title=title, height=240)
        .mark_line(point=True)
        .encode(
            alt.X(x, title=None), alt.Y(y, title=None), alt.Color(series, title=None), alt.Shape(series, title=None)
        )
    )


every = ask("select distinct operator from flights order by operator")["operator"].to_list()
own = st.sidebar.multiselect("Operators", every, default=every)
(last,) = ask("select strftime(max(landed_at), '%Y-%m-%d %H:%M') from flights").row(0)
st.sidebar.caption(f"Last landing on record: {last} UTC. Each table is one select over a view of that name.")
st.title("Fleet")

costs = ask("from operator_costs where operator in (select unnest(?)) order by operator, component", own)
ranking = ask("from fleet_ranking where operator in (select unnest(?)) order by place", own)
money = next(iter(costs["currency"].unique()), "")
for column, (label, value) in zip(
    st.columns(5),
    {
        "Act now": ranking.filter(urgency="act").height,
        "Plan": ranking.filter(urgency="plan").height,
        "Messages so far": costs["n_messages"].sum(),
        f"Messages to expect, {money}": f"{costs['expected_message_cost'].sum():,.0f}",
        f"Saved at most, {money}": f"{costs['saving_at_most'].sum():,.0f}",
    }.items(),
    strict=True,
):
    column.metric(label, value)
tonight, wear, leads, spent, seasons = st.tabs(["Tonight", "Wear", "Leads", "Costs", "Seasons"])

with tonight:
    st.caption("`fleet_ranking`: the most urgent pack first")
    names = ["place", "tail", "pack", "urgency", "diagnoses", "hx_fouling", "rul_flights", "rul_low", "p_event_50"]
    share = st.column_config.ProgressColumn(format="percent", min_value=0.0, max_value=1.0)
    st.dataframe(
        ranking.select(names),
        hide_index=True,
        column_config={"hx_fouling": share, "p_event_50": share}
        | {n: st.column_config.NumberColumn(format="%.0f") for n in ("rul_flights", "rul_low")},
    )

with wear:
    packs = {f"{r['tail']} pack {r['pack']}": (r["operator"], r["tail"], r["pack"]) for r in ranking.to_dicts()}
    pack = st.selectbox("Pack", packs) if packs else None
    health = ask(
        """select departed_at, value, value - 1.645 * sd as low, value + 1.645 * sd as high from health_parameters
        where parameter = 'hx_fouling' and value is not null and (operator, tail, pack) = (?, ?, ?) order by 1""",
        *packs.get(pack, ("", "", 0)),
    )
    base = alt.Chart(health, title="Conductance lost, with its 90 % interval", height=320).encode(
        alt.X("departed_at:T", title=None)
    )
    band = base.mark_area(opacity=0.25).encode(alt.Y("low:Q", title=None, axis=alt.Axis(format="%")), alt.Y2("high:Q"))
    st.altair_chart(band + base.mark_line().encode(alt.Y("value:Q")), width="stretch")

with leads:
    st.caption("`removal_leads`: flights from a unit's first alert to its message and to its removal or wash")
    found = ask(f"select *, {UNIT} as unit from removal_leads where operator in (select unnest(?))", own)
    found = found.filter(pl.col("flights_to_work").is_not_null()).sort("flights_to_work", descending=True)
    st.bar_chart(found, x="unit", y=["flights_to_message", "flights_to_work"], stack=False, horizontal=True,
                 x_label="", y_label="flights")  # fmt: skip
    st.dataframe(found.drop("alert_id", "unit", "begins_at", "work_at"), hide_index=True)

with spent:
    st.caption("`operator_costs` at the figures of `costs.toml`; default: a figure of ours, to be replaced")
    parts = ["messages_cost", "removals_cost", "washes_cost"]
    st.bar_chart(costs.group_by("operator").agg(pl.col(parts).sum()), x="operator", y=parts, horizontal=True,
                 x_label="", y_label=money)  # fmt: skip
    st.dataframe(costs, hide_index=True)
    st.caption(
        "`realised_savings`. Nobody can know whether a message that did not come would have come: at most takes it as"
        " certain, expected as likely as the prognosis before the work."
    )
    st.dataframe(
        ask("from realised_savings where operator in (select unnest(?)) order by work_on", own).drop("alert_id"),
        hide_index=True,
    )

with seasons:
    st.caption("`seasonality`: by calendar month and operator")
    months = ask("from seasonality where operator in (select unnest(?)) order by calendar_month", own)
    for column, (name, title) in zip(
        st.columns(3),
        {"hx_fouling": "Loss", "p_event_50": "Chance in 50 flights", "margin_k": "Cooling margin [K]"}.items(),
        strict=True,
    ):
        column.altair_chart(lines(months, "calendar_month:O", f"{name}:Q", title), width="stretch")
