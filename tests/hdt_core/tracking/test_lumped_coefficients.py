"""Equations (7) and (8) turned round, by hand."""

import numpy as np
import pytest
from by_hand import flights

from hdt_core.tracking.lumped_coefficients import lumped_coefficients


def test_the_papers_coefficients_where_the_outlets_allow():
    """The outlets are known to 1 K each: their difference must be four times its deviation."""
    outlets = [300.0, 315.0, 330.0, None]
    rows = lumped_coefficients(
        flights(4, hx_in_k=400.0, hx_out_k=320.0, tat_k=250.0, ram_out_k=outlets, pack_flow_kg_s=0.8, ram_flow_kg_s=1.6)
    )
    hot, cold = (rows.filter(parameter=name).row(0, named=True) for name in ("hx_h_hot_w_k", "hx_h_cold_w_k"))
    assert hot["value"] == pytest.approx(0.8 * 1009.0 * 80.0 / 20.0)
    assert cold["value"] == pytest.approx(1.6 * 1005.0 * 50.0 / 20.0)
    across_sd_k = np.hypot(1.0, 1.0)
    assert hot["sd"] / hot["value"] == pytest.approx(np.hypot(across_sd_k / 20.0, 0.02))
    assert cold["sd"] / cold["value"] == pytest.approx(np.hypot(across_sd_k / 20.0, 0.08))
    assert rows["status"].to_list() == ["ok", *["not_identifiable"] * 3] * 2
    assert rows["value"].null_count() == rows["sd"].null_count() == 6


@pytest.mark.parametrize(("across_k", "is_ok"), [(5.6, False), (5.7, True)])
def test_a_difference_counts_from_four_deviations_on(across_k, is_ok):
    row = flights(1, hx_in_k=400.0, hx_out_k=300.0 + across_k, tat_k=250.0, ram_out_k=300.0, pack_flow_kg_s=0.8,
                   ram_flow_kg_s=1.6)  # fmt: skip
    assert (lumped_coefficients(row)["status"] == "ok").all() == is_ok
