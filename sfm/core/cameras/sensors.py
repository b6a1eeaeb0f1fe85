"""Widths of the sensors of well-known cameras, in mm along the longer side, from their public specifications.

It serves photos whose EXIF has the focal length in mm but no 35 mm equivalent: early digital cameras, interchangeable
lenses, drones. Phones since about 2013 write the equivalent and are left out.
"""

from __future__ import annotations

import re

# A line is a width and the cameras that have it; markets' names of one camera stand side by side.
_SENSORS_MM: dict[str, dict[float, str]] = {
    "canon": {
        36.0: "EOS 5D Mark II, EOS 5D Mark III, EOS 5D Mark IV, EOS 5DS, EOS 5DS R, EOS-1D X, EOS-1Ds Mark III, "
        "EOS R, EOS R5, EOS R6, EOS R6m2, EOS R3",
        35.9: "EOS 6D Mark II, EOS RP, EOS R8, EOS-1D X Mark II, EOS-1D X Mark III",
        35.8: "EOS 5D, EOS 6D, EOS-1Ds",
        28.1: "EOS-1D Mark III",
        27.9: "EOS-1D Mark IV",
        22.7: "EOS 10D, EOS D60, EOS 300D DIGITAL, EOS DIGITAL REBEL",
        22.5: "EOS 20D, EOS 30D, EOS 70D, EOS 80D",
        22.4: "EOS 7D Mark II",
        22.3: "EOS 50D, EOS 60D, EOS 7D, EOS 100D, EOS REBEL SL1, EOS 500D, EOS REBEL T1i, EOS 550D, EOS REBEL T2i, "
        "EOS 600D, EOS REBEL T3i, EOS 650D, EOS REBEL T4i, EOS 700D, EOS REBEL T5i, EOS 750D, EOS REBEL T6i, "
        "EOS 760D, EOS 800D, EOS REBEL T7i, EOS 77D, EOS 90D, EOS M, EOS M5, EOS M6, EOS M50, EOS 200D, EOS R7, "
        "EOS R10, EOS 1200D, EOS REBEL T5, EOS 1300D, EOS REBEL T6, EOS 2000D, EOS REBEL T7",
        22.2: "EOS 40D, EOS 350D DIGITAL, EOS DIGITAL REBEL XT, EOS 400D DIGITAL, EOS DIGITAL REBEL XTi, EOS 450D, "
        "EOS DIGITAL REBEL XSi, EOS 1000D, EOS DIGITAL REBEL XS, EOS 1100D, EOS REBEL T3",
        18.7: "PowerShot G1 X",
        13.2: "PowerShot G7 X, PowerShot G7 X Mark II, PowerShot G9 X, PowerShot G5 X, PowerShot G3 X",
        7.44: "PowerShot G10, PowerShot G11, PowerShot G12, PowerShot G15, PowerShot G16, PowerShot S90, "
        "PowerShot S95, PowerShot S100, PowerShot S110, PowerShot S120",
        7.18: "PowerShot G3, PowerShot G5, PowerShot G6, PowerShot A620, PowerShot A640, PowerShot A95",
        6.17: "PowerShot SX30 IS, PowerShot SX40 HS, PowerShot SX50 HS, PowerShot SX60 HS, PowerShot SX10 IS",
        5.76: "PowerShot S3 IS, PowerShot S5 IS, PowerShot A530, PowerShot A570 IS, PowerShot SD700 IS",
    },
    "nikon": {
        36.0: "D3, D3S, D4, D4S, D700, Df",
        35.9: "D3X, D5, D6, D600, D610, D750, D780, D800, D800E, D810, D850, Z 5, Z 6, Z 6_2, Z 7, Z 7_2, Z 8, Z 9",
        23.7: "D40, D50, D70, D70s, D100, D1, D1X",
        23.6: "D40X, D60, D80, D90, D200, D300, D300S, D3000, D5000, D5100, D7000",
        23.5: "D500, D3300, D3400, D3500, D5200, D5300, D5500, D5600, D7100, D7200, D7500, Z 50, Z fc, Z 30",
        23.2: "D3200",
        23.1: "D3100",
        13.2: "1 J1, 1 J2, 1 J3, 1 J4, 1 J5, 1 V1, 1 V2, 1 V3, COOLPIX A900",
        7.44: "COOLPIX P7000, COOLPIX P7100, COOLPIX P7800",
        6.17: "COOLPIX P510, COOLPIX P520, COOLPIX P600, COOLPIX P900, COOLPIX P1000",
    },
    "sony": {
        35.9: "DSLR-A900, DSLR-A850, ILCE-7R, ILCE-7RM2, ILCE-7RM3, ILCE-7M4, SLT-A99",
        35.8: "ILCE-7, ILCE-7M2, ILCE-7M3, ILCE-7S, DSC-RX1, DSC-RX1R",
        35.7: "ILCE-7RM4, ILCE-7RM5",
        35.6: "ILCE-7SM2, ILCE-7SM3, ILCE-9, ILCE-7C",
        23.6: "DSLR-A100, DSLR-A200, DSLR-A300, DSLR-A350",
        23.5: "DSLR-A700, NEX-6, NEX-7, ILCE-5100, ILCE-6000, ILCE-6100, ILCE-6300, ILCE-6400, ILCE-6500, ILCE-6600, "
        "SLT-A55V, SLT-A65V, SLT-A77V",
        23.4: "NEX-3, NEX-5, NEX-5N, NEX-C3",
        23.2: "ILCE-5000, ILCE-3000",
        21.5: "DSC-R1",
        13.2: "DSC-RX100, DSC-RX100M2, DSC-RX100M3, DSC-RX100M4, DSC-RX100M5, DSC-RX100M6, DSC-RX100M7, DSC-RX10, "
        "DSC-RX10M2, DSC-RX10M3, DSC-RX10M4",
        8.8: "DSC-F828, DSC-F717, DSC-F707",
    },
    "fujifilm": {
        43.8: "GFX 50S, GFX 50R, GFX 100, GFX100S",
        23.6: "X-Pro1, X-E1, X-E2, X-M1, X-T1, X-T2, X-T10, X-T20, X100, X100S, X100T, X100F",
        23.5: "X-T3, X-T4, X-T5, X-T30, X-H1, X-Pro3, X-S10, X100V",
        8.8: "X10, X20, X-S1",
    },
    "olympus": {
        17.3: "E-1, E-3, E-5, E-30, E-300, E-330, E-400, E-410, E-420, E-500, E-510, E-520, E-620, E-P1, E-P2, E-P3, "
        "E-P5, E-PL1, E-PL2, E-PL3, E-PL5, E-PL7, E-M1, E-M1MarkII, E-M1MarkIII, E-M5, E-M5MarkII, E-M10, PEN-F",
        8.8: "C8080WZ",
        6.17: "TG-4, TG-5, TG-6",
    },
    "panasonic": {
        17.3: "DMC-G1, DMC-G2, DMC-G3, DMC-G5, DMC-G6, DMC-G7, DMC-GF1, DMC-GF2, DMC-GF3, DMC-GX1, DMC-GX7, DMC-GX8, "
        "DMC-GH1, DMC-GH2, DMC-GH3, DMC-GH4, DC-GH5, DC-GH6, DC-G9, DC-GX9, DMC-GM1",
        35.6: "DC-S1, DC-S1R, DC-S5",
        13.2: "DMC-FZ1000, DC-FZ1000M2, DMC-TZ100, DMC-ZS100, DMC-CM1",
        6.17: "DMC-FZ150, DMC-FZ200, DMC-FZ300",
    },
    "pentax": {
        35.9: "K-1, K-1 Mark II",
        23.7: "K-5, K-5 II, K-5 II s, K-30, K-50",
        23.6: "K100D, K-x, K-r, K-01",
        23.5: "*ist D, *ist DS, *ist DL, K10D, K-3, K-3 II, K-70, KP",
        23.4: "K20D, K-7",
    },
    "leica": {
        45.0: "S2",
        36.0: "M9, M9 Digital Camera, M Monochrom, Q, Q2, M10",
        35.8: "M, SL",
        27.0: "M8, M8 Digital Camera",
    },
    "ricoh": {23.7: "GR, GR II", 23.5: "GR III, GR IIIx"},
    "sigma": {24.0: "DP1 Merrill, DP2 Merrill, DP3 Merrill, SD1", 20.7: "DP1, DP2, DP1S, DP2S, SD14, SD15"},
    "samsung": {23.5: "NX1, NX10, NX100, NX200, NX300, NX500, NX20, NX30"},
    "kodak": {7.18: "DC4800 ZOOM, DX6490"},
    "hasselblad": {43.8: "X1D, X1D II 50C, X2D 100C", 17.3: "L2D-20c", 13.2: "L1D-20c"},
    "dji": {
        17.3: "FC4280, L2D-20c",
        13.2: "FC6310, FC6310S, FC6310R, FC3411, L1D-20c",
        9.6: "FC3582, FC8482",
        6.4: "FC3170, FC2204",
        6.17: "FC200, FC220, FC300C, FC300S, FC300X, FC300SE, FC330, FC350, FC2103, FC2200, FC7203, FC7303",
    },
    "gopro": {
        6.17: "HERO3+ Black Edition, HERO4 Black, HERO4 Silver, HERO5 Black, HERO6 Black, HERO7 Black, HERO8 Black"
    },
    "apple": {4.89: "iPhone 5s", 4.54: "iPhone 4, iPhone 4S, iPhone 5"},
}


def sensor_width_mm(make: str, model: str) -> float | None:
    """Width of the sensor in mm, or None where the camera is not in the table.

    `make` and `model` are EXIF's; capitals, punctuation, company suffixes and a repeated make do not matter.
    """
    maker = _maker(model) or _maker(make)  # the model first: Pentax cameras are made by "RICOH IMAGING"
    return _TABLE.get((maker, _bare_model(maker, model))) if maker else None


def _maker(text: str) -> str:
    """The make of the table with which `text` starts, or nothing."""
    bare = _normalised(text)
    return next((name for name in _SENSORS_MM if bare.startswith(name)), "fujifilm" if bare.startswith("fuji") else "")


def _bare_model(maker: str, model: str) -> str:
    return _normalised(re.sub(rf"^\s*{maker}\b", "", model.lower()))


def _normalised(text: str) -> str:
    return re.sub(r"[^a-z0-9+*]", "", text.lower())


_TABLE = {
    (maker, _normalised(model)): width
    for maker, widths in _SENSORS_MM.items()
    for width, models in widths.items()
    for model in models.split(", ")
}
