"""Layouts of seven ACMS reports of the A330, named as their headings are, and bleed and packs of any report's head.

In `C3`, which says what the bleed and the packs did, the headings leave the names to the reader. That the two numbers
are pack flows, the pairs of digits the bleed valves of engines 1 and 2, and what stands between them the cross-feed, is
read from reports before, during and after an engine start, and is not documented.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

from hdt_recorder.decoding.printed import ReportLine, Reports, Value, read_layouts

A330 = read_layouts(
    """
<**>
C1 {acid:s} {date:7s} {utc:8s} {from:4s} {to:4s} {flight:s} {code:4s} {count:3}
C2 {prv:3s} {phase:4} {tiebck:6s} {dmu:s} {mod:3s} {ap1:3s} {ap2:3s}
C3 {tat:5} {alt:5} {mn:5} {sys:3s} {pack_flow_1:4} {status_1:3s} {bleed_1:2s} {crossfeed:1} \
{bleed_2:2s} {status_2:3s} {pack_flow_2:4} {apu:1s}
 ACID:{acid:s} DATE:{date:7s} FLT:{flight:s} CODE:{code:4s} CNT:{count:3}

<08> ENGINE TRIM BALANCE
C5|C6 {esn:6s} {ehrs:5} {ert:5} {ecyc:5} {ecw1:5s} {vib1:4} {vib2:4}
E. {utc:8s} {phase:4} {alt:5} {mn:6}
S.|T. {vf:4} {vc:4} {vh:4} {vl:4} {phf:3} {pht:3} {bbf:4} {bbt:4} {n1:6} {n2:5} {evm:5s}

<10> ENGINE START
C5|C6 {esn:6s} {ehrs:5} {ert:5} {ecyc:5} {ecw1:5s} {ecw3:5s} {mw03:5s} {mw10:5s} {mw11:5s}
N1 {e:1} {max:4} {mxn2:5} {tos:3} {ttp:3} {tta:3} {ttf:3} {tfe:3} {ff:5} {pd:2} {s:2s}
S. {n1:6} {n2:5} {n2r:5} {egt:4} {p5:6} {ff:5} {ffr:5} {p2:6} {p25:6}
T. {t25:5} {t295:4} {t3:5} {p3:5} {sva:6} {ffmu:5} {b25:5} {ecw4:5s} {ecw5:5s}

<13> APU MES/IDLE
E1 {asn:4s} {ahrs:5} {acyc:5} {ecid:6s} {acw1:5s}
N1|N2|N3 {esn:6s} {egta:4} {gla:3} {wb:4} {pt:4} {p2a:4} {lcot:4} {lcit:4} {igv:3} {scv:3} {lot:3} {hot:3}
V1 {sta:3} {egtp:4} {npa:3} {lot:3} {lcit:4}

<15> LOAD
N1 {ralt:4} {cas:3} {gw:6} {cg:4} {flap:5} {slat:5}
N2|N3 {vrta:6} {lona:6} {lata:6} {roll:5} {rolr:5} {ptch:5} {ptcr:5} {ralr:5} {lim1:7}
S.|.S {vrta:6} {lona:6} {lata:6} {roll:5} {rolr:5} {ptch:5} {ptcr:5} {ralr:5} {ralt:4}
 REASON:{reason:t}

<18> EBS
C2 {prv:3s} {phase:4} {tiebck:6s} {dmu:s} {mod:3s} {ap1:3s} {ap2:3s} {cas:3} {czl:8s}
C3 {tat:5} {alt:5} {mn:5} {sys:3s} {pack_flow_1:4} {status_1:3s} {bleed_1:2s} {crossfeed:1} \
{bleed_2:2s} {status_2:3s} {pack_flow_2:4} {apu:1s} {nl:3} {tte:3}
C5|C6 {esn:6s} {ehrs:5} {ert:5} {ecyc:5} {ecw1:5s} {ecw2:5s} {epr:5} {egt:4} {fav:1}
E.|.E|N.|.N {n1:6} {n2:5} {p30:5} {t30:5} {tpo:4} {pd:2} {cot:3} {ro:3} {ri:3} {pf:4} {tw} {prv:1} {hpv:1}
S.|.S|T.|.T {cit} {hxt} {atw} {atpo:4} {apd} {hxc} {bts} {pip} {pud} {php:2s} {tp} {ptv} {fv:1} {za:1s} {pbv:1}
V.|.V {alt:5} {zcb:5} {pdc:4} {zld:5} {vscb:5} {tat:5} {sat:5} {pcw1:5s} {pcw2:5s} {fov:3}
X.|.X {v1:3} {v2:3} {v3:3} {v4:3} {v5:3} {v6:3} {v7:3} {st1:4} {st2:4} {st3:4} {st4:4} {st5:4} {aov:3} {cpc:1}
 REASON :{reason:t}

<37> FLEET SURVEY
A1 START UTC: {start_utc:8s} STOP UTC: {stop_utc:8s}
A2 NX MAX : {nx_max} NX MIN : {nx_min}
A3|D3|I3 {nwa1:4} {nwa2:4} {nwa3:4} {nwa4:4} {nwa5:4} {nwa6:4} {nwa7:4} {nwa8:4} {nwa9:4} {nwa10:4}
A4|D4|I4 {hr1:5} {hr2:5} {hr3:5} {hr4:5} {hr5:5} {hr6:5} {hr7:5} {hr8:5} {hr9:5} {hr10:5}
B1|D1|H1 UTC: {utc:8s}
B2 {zfw:6} {zfcg:4} {fq:6} {gw:6} {cg:4}
D2|I2 GS MAX: {gs_max:3} NUMB BRAKES: {brakes:2} NX MAX: {nx_max:6} NX MIN: {nx_min:6}
E1 UTC: {utc:8s} GW: {gw:6} CG: {cg:4} TRAV: {trav:5} FTOT: {ftot:3}
E2 {derate:8s} {apu_pb:1} {apu_bv:1} {alt:5} {sat:5} {slat:5} {flap:5}
E3 CAS: {cas:3} GS: {gs:3}
E4 NZ MAX: {nz_max:5} PTCR MAX: {ptcr_max:5}
F1 UTC AT CRUISE START: {utc:8s}
F2 ALT MAX: {alt_max:5} SAT MIN: {sat_min:3} TAT MIN: {tat_min:3}
G1|G2 {b1} {b2} {b3} {b4} {b5} {b6} {b7} {b8} {b9} {b10} {b11} {b12}
H2 {gw:6} {cg:4} {fq:6} {fqlo:5} {fqro:5} {sat:3} {autobrake:t}
H3 VRTG MAX: {vrtg_max:5} TRAV MIN: {trav_min:5}
I1 UTC AT TAXI START: {start_utc:8s} UTC AT TAXI END: {end_utc:8s}

<50> CRUISE STABILITY STATISTIC
C4 {tat:5} {alt:5} {mn:5} {sys:3s}
C5 {date:7s} {utc:8s}
C6|C7 {esn:6s} {ehrs:5} {ert:5} {ecyc:5} {ecw1:5s} {evm:5s} {qa_qe:3s}
N1|N2 {epr:5} {eprc:5} {n1:6} {n2:5} {egt:4} {p5:6} {ff:5} {p2:6} {p25:6}
S1|S2 {t25:5} {t295:5} {p3:5} {t3:5} {hptc:5} {lptc:5} {sva:6} {b25:5}
T1|T2 {gle:5} {pd:2} {tn:3} {oip:3} {oit:5} {oc:1} {vf:4} {vc:4} {vh:4} {vl:4}
X1|X2 {phf:3} {pht:3} {bbf:4} {bbt:4} {elev:5} {aoa:5} {da:5} {civv:4} {cfpg:7} {latp:6s}
X3 {rudd:5} {rudt:5} {stab:5} {roll:5} {yaw:5} {ptch:5} {drm:6} {gw:6} {cg:4}
X4|X5 {rsp1:5} {rsp2:5} {rsp3:5} {rsp4:5} {rsp5:5} {rsp6:5} {flap:5} {slat:5} {thdg:6}
X6|X7 {aill:5} {ailr:5} {ws:3} {wd:4} {aft:5} {afd:5} {ialt:5} {gs:3} {vacc:6}
"""
)


PACK_NUMBERS = (1, 2)
_CLOSED_DIGIT = "0"


@dataclass(frozen=True, slots=True)
class ReportHead:
    """Head of one report.

    Attributes
    ----------
    number : str
        Of its layout.
    line : int
        Of the file, from 1.
    aircraft : str
        Registration, without the dots that fill it.
    printed_at : datetime
        UTC.
    altitude_ft, mach : float, optional
    pack_flow_kg_s : tuple of float or None
        Of pack 1 and 2.
    bleed_open : tuple of bool or None
        Whether any bleed valve of engine 1 and 2 is open.
    crossfeed_open : bool, optional
    """

    number: str
    line: int
    aircraft: str
    printed_at: datetime
    altitude_ft: float | None
    mach: float | None
    pack_flow_kg_s: tuple[float | None, ...]
    bleed_open: tuple[bool | None, ...]
    crossfeed_open: bool | None


def report_heads(reports: Reports) -> Iterator[ReportHead | ReportLine]:
    """Yield a head per report; of a report without a time, its first readable line.

    Fields go by the names they have in `report_layouts.A330`: `acid`, `date`, `utc`, `alt`, `mn`, and, with the number
    of pack or engine, `pack_flow_1`, `bleed_1`, `crossfeed`. What a layout of another aircraft does not name is None.
    """
    by_report: dict[int, list[ReportLine]] = {}
    for line in reports.lines:
        by_report.setdefault(line.report, []).append(line)
    for lines in by_report.values():
        yield _head(lines) or lines[0]


def _head(lines: list[ReportLine]) -> ReportHead | None:
    values: dict[str, Value] = {}
    for line in lines:
        values = dict(line.values) | values  # a name that comes again, as time and altitude do, is no longer the head's
    moment = _moment(values)
    if moment is None:
        return None
    flows = tuple(_number(values, f"pack_flow_{n}") for n in PACK_NUMBERS)
    bleeds = tuple(_is_open(values, f"bleed_{n}") for n in PACK_NUMBERS)
    aircraft = str(values.get("acid") or "").strip(".")
    return ReportHead(lines[0].number, lines[0].line, aircraft, moment, _number(values, "alt"), _number(values, "mn"),
                      flows, bleeds, _is_open(values, "crossfeed"))  # fmt: skip


def _moment(values: Mapping[str, Value]) -> datetime | None:
    try:
        return datetime.strptime(f"{values['date']} {values['utc']}", "%d%b%y %H.%M.%S").replace(tzinfo=UTC)
    except (KeyError, ValueError):
        return None


def _number(values: Mapping[str, Value], name: str) -> float | None:
    value = values.get(name)
    return value if isinstance(value, float) else None


def _is_open(values: Mapping[str, Value], name: str) -> bool | None:
    """Return whether any digit means open; None for text without digits only."""
    value = values.get(name)
    word = f"{value:.0f}" if isinstance(value, float) else value or ""
    return word.strip(_CLOSED_DIGIT) != "" if word.isdigit() else None
