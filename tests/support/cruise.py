"""What a pack records in cruise."""

CRUISE = {
    "altitude_m": 11_000.0, "mach": 0.82, "tat_k": 250.0, "total_pressure_pa": 35_000.0, "hx_in_k": 405.0,
    "hx_out_k": 296.0, "ram_door_open": 0.3, "pack_flow_kg_s": 0.77, "ram_out_k": 335.0, "cc_speed_rad_s": 3_600.0,
    "cc_in_k": 251.0, "cc_in_pa": 33_500.0, "cc_out_k": 365.0, "cc_out_pa": 93_000.0, "cc_flow_kg_s": 0.8,
    "vda_counts": 400.0,
}  # fmt: skip
