"""The numbers that the paper prints, by table, subject, row and column, and where they contradict each other."""

import re

Numbers = dict[str, dict[str, float]]
"""Of one subject, or their average: row, column, number."""
AVERAGE = ""
"""In place of a subject: what the paper prints as the average, or of the one subject that a table is about."""
SUBJECTS = ("313", "377", "386", "387", "390", "392", "393", "394")
METHODS = ("HumanNeRF", "MonoHuman", "NPC", "Vid2Avatar", "Ours")

_VIEW = """
S313 29.49 .965 30.46  9.43 29.55 .966 31.40  7.25 29.70 .966 36.29 54.37 28.44 .966 37.74 30.08 28.79 .966 29.61 10.42
S377 30.15 .974 23.17  5.37 30.22 .976 23.70  3.95 30.52 .977 22.29  4.75 29.52 .975 24.91 12.52 29.92 .977 19.85  3.47
S386 32.69 .973 31.99 31.06 32.77 .970 36.69 28.08 32.07 .973 36.88 79.70 33.04 .977 30.65 23.42 33.00 .977 27.62 15.45
S387 27.95 .962 34.85 15.70 28.20 .962 37.99 21.99 27.76 .962 43.34 80.01 28.15 .965 40.26 25.17 28.09 .964 33.70 14.72
S390 30.16 .968 33.09 19.53 30.27 .968 34.68 20.00 29.74 .963 46.02 71.72 30.73 .970 37.33 22.27 30.66 .970 32.86 15.51
S392 30.70 .970 32.02  9.88 30.94 .971 32.30  6.26 31.70 .972 33.34 38.44 30.46 .971 36.58 31.50 31.18 .973 29.17 10.31
S393 28.38 .961 34.95 12.67 28.40 .961 36.64 10.20 28.61 .963 40.88 55.83 27.94 .962 40.93 39.11 28.49 .963 34.62 14.83
S394 30.00 .962 33.98 10.18 30.02 .963 34.38  7.64 30.07 .963 38.38 41.14 29.82 .965 36.46 37.11 30.68 .967 29.74  9.07
Avg  29.94 .967 31.81 14.23 30.03 .967 33.47 13.18 30.01 .967 37.18 53.24 29.76 .969 35.61 27.65 30.11 .970 29.64 11.72
"""
_POSE = """
S313 28.08 .961 32.37 12.17 28.24 .963 32.81  8.02 27.41 .963 37.13 53.82 28.00 .965 38.43 32.55 28.41 .967 29.01 10.85
S377 30.12 .976 22.68  5.63 30.23 .977 23.87  3.31 30.61 .978 21.55  4.42 29.80 .977 24.77 15.94 30.22 .978 19.25  3.26
S386 32.11 .970 34.48 25.23 32.41 .968 39.45 25.10 31.71 .971 37.95 68.22 32.48 .975 32.43 24.64 32.91 .975 28.51 10.80
S387 27.55 .962 34.67 17.47 27.61 .961 38.34 23.90 27.24 .962 42.14 83.10 27.34 .964 40.83 29.66 27.75 .964 32.42 17.38
S390 30.01 .967 32.24 12.43 30.62 .968 35.84 17.55 30.02 .965 42.60 60.21 30.81 .971 34.73 28.09 31.10 .972 28.91 16.79
S392 30.61 .970 32.08  5.93 30.88 .971 33.52  5.09 31.33 .972 34.88 44.54 30.50 .971 37.53 46.91 30.95 .972 29.80 10.79
S393 28.36 .961 34.31 10.70 28.75 .963 35.43  9.46 28.76 .963 39.03 51.61 28.09 .962 40.17 38.36 28.81 .963 31.71 11.26
S394 28.78 .960 34.64  8.95 29.10 .961 34.75  8.41 29.77 .963 36.90 32.45 29.24 .963 36.61 35.94 29.69 .965 29.41  7.61
Avg  29.45 .966 32.18 12.32 29.73 .967 34.25 12.61 29.61 .967 36.52 49.79 29.53 .969 35.69 31.51 29.98 .970 28.60 11.09
"""
_V2A_VIEW = """
S313 26.82 .913 98.74
S377 29.51 .951 70.62
S386 31.16 .944 76.46
S387 28.09 .938 83.55
S390 28.07 .923 92.48
S392 30.37 .943 82.93
S393 27.19 .929 83.42
S394 28.95 .931 81.31
"""
_V2A_POSE = """
S313 26.67 .913 97.79
S377 29.86 .953 68.45
S386 30.85 .941 77.00
S387 27.42 .938 80.78
S390 28.88 .926 88.08
S392 30.20 .942 84.57
S393 27.20 .929 82.50
S394 28.54 .932 78.80
"""
_GEOMETRY = """
S313 .197 .661 .289 .637 .039 .824 .017 .916 .014 .904
S377 .307 .630 .368 .616 .046 .838 .036 .859 .020 .894
S386 .286 .638 .423 .649 .061 .780 .021 .896 .024 .862
S392 .340 .590 .414 .580 .067 .804 .038 .868 .037 .861
S393 .121 .689 .177 .649 .117 .751 .088 .865 .086 .818
S394 .199 .686 .239 .685 .141 .774 .117 .864 .108 .837
Avg  .242 .649 .318 .636 .079 .795 .053 .878 .048 .863
"""
_ABLATION = {
    "w/o {s1, c1}": (30.13, 0.965, 31.00, 29.36, 0.962, 31.01),
    "w/o {s2, c2}": (29.56, 0.963, 32.46, 29.26, 0.962, 31.30),
    "w/o L_com": (30.08, 0.964, 31.40, 29.47, 0.963, 30.90),
    "w/o feat": (29.49, 0.962, 33.41, 29.15, 0.961, 32.77),
    "Pose_lf": (30.11, 0.965, 29.83, 29.28, 0.963, 30.53),
    "Ours": (30.68, 0.967, 29.74, 29.69, 0.965, 29.41),
}
_FREQUENCY = {
    "[5]": (30.24, 0.966, 30.78, 29.58, 0.964, 30.34),
    "[6]": (30.14, 0.965, 30.74, 29.46, 0.963, 30.40),
    "[8]": (30.27, 0.965, 30.89, 29.53, 0.963, 30.02),
    "[10]": (30.13, 0.965, 31.00, 29.36, 0.962, 31.01),
    "[6, 6]": (29.92, 0.963, 37.32, 29.56, 0.963, 35.46),
    "[6, 8]": (29.88, 0.964, 40.14, 29.52, 0.964, 38.79),
    "[8, 8]": (30.11, 0.963, 37.98, 29.53, 0.963, 35.53),
    "[6, 10]": (29.91, 0.964, 35.25, 29.55, 0.964, 33.58),
    "[8, 10]": (29.18, 0.958, 56.72, 28.76, 0.957, 54.61),
    "[10, 10]": (29.86, 0.963, 35.30, 29.44, 0.962, 34.23),
    "[5, 10]": (30.36, 0.967, 30.03, 29.68, 0.965, 29.48),
}
_WILD = {
    "HumanNeRF": (31.35, 63.28, 33.72, 72.29, 0.242, 0.649),
    "MonoHuman": (32.73, 65.23, 34.39, 79.94, 0.318, 0.636),
    "NPC": (29.59, 53.62, 35.28, 80.17, 0.079, 0.795),
    "Vid2Avatar": (36.85, 187.24, 40.52, 198.51, 0.053, 0.878),
    "Ours": (28.52, 56.57, 31.74, 69.13, 0.047, 0.863),
}
_FLOW = {
    "HumanNeRF": 0.170, "MonoHuman": 0.162, "NPC": 0.159, "Vid2Avatar": 0.163, "[5]": 0.167, "[6]": 0.164,
    "[8]": 0.159, "[10]": 0.163, "[5, 10]": 0.154, "[6, 10]": 0.160, "[8, 10]": 0.166,
}  # fmt: skip
_PM_AVATAR = (30.27, 0.969, 38.38, 39.64, 29.87, 0.969, 39.26, 40.16)

FOUR = tuple(f"{part} {metric}" for part in ("view", "pose") for metric in ("PSNR", "SSIM", "LPIPS", "KID"))
THREE = tuple(f"{part} {metric}" for part in ("view", "pose") for metric in ("PSNR", "SSIM", "LPIPS"))


def _by_subject(view: str, pose: str, methods: tuple[str, ...], metrics: tuple[str, ...]) -> dict[str, Numbers]:
    """Tables with a line a subject and some numbers a method, for novel views and novel poses."""
    found: dict[str, Numbers] = {}
    for part, text in (("view ", view), ("pose ", pose)):
        for line in text.strip().splitlines():
            subject, *words = line.split()
            rows = found.setdefault(subject[1:] if subject != "Avg" else AVERAGE, {})
            for number, word in enumerate(words):
                method, metric = methods[number // len(metrics)], metrics[number % len(metrics)]
                rows.setdefault(method, {})[f"{part}{metric}".strip()] = float(word)
    return found


def _named(rows: dict[str, tuple[float, ...]], columns: tuple[str, ...]) -> Numbers:
    return {row: dict(zip(columns, numbers, strict=True)) for row, numbers in rows.items()}


_SUBJECTS = _by_subject(_VIEW, _POSE, METHODS, ("PSNR", "SSIM", "LPIPS", "KID"))
_MASKED = {
    subject: {"V2A_mask": {name: rows["Vid2Avatar"][name] for name in THREE}} for subject, rows in _SUBJECTS.items()
}
_UNMASKED = _by_subject(_V2A_VIEW, _V2A_POSE, ("V2A*",), ("PSNR", "SSIM", "LPIPS"))
_SHAPES = _by_subject(_GEOMETRY, "", METHODS, ("CD", "NC"))

PRINTED: dict[str, dict[str, Numbers]] = {
    "main": {AVERAGE: _SUBJECTS[AVERAGE] | {"PM-Avatar": dict(zip(FOUR, _PM_AVATAR, strict=True))}},
    "subjects": {subject: rows for subject, rows in _SUBJECTS.items() if subject != AVERAGE},
    "wild": {
        AVERAGE: _named(_WILD, ("Story LPIPS", "Story FID", "Invisible LPIPS", "Invisible FID", "CD", "NC")),
        **{
            subject: {m: {n.removeprefix("view "): x for n, x in numbers.items()} for m, numbers in rows.items()}
            for subject, rows in _SHAPES.items() if subject != AVERAGE
        },
    },
    "ablation": {AVERAGE: _named(_ABLATION, THREE)},
    "frequency": {AVERAGE: _named(_FREQUENCY, THREE)},
    "beyond": {},
    "consistency": {AVERAGE: {row: {"flow": number} for row, number in _FLOW.items()}},
    "masks": {subject: _MASKED[subject] | rows for subject, rows in _UNMASKED.items()},
}  # fmt: skip
"""By table and subject. The paper has PM-Avatar in the first table only."""

NOTES: dict[str, tuple[str, ...]] = {
    "main": (
        "The paper prints its own novel-view PSNR, 30.11, in bold as the best; PM-Avatar's is higher, 30.27.",
        'The caption says "over 10% improvement in LPIPS and KID"; for novel-view LPIPS it is 7 % (29.64 against '
        "31.81).",
        "Which SSIM the paper means is unknown; here it has the data range 2 that programs of its time had for floats.",
    ),
    "subjects": (
        "In the paper's novel-pose table two KIDs in bold are not the best: subject 392 (5.93, MonoHuman has 5.09) and "
        "subject 393 (10.70, MonoHuman has 9.46).",
    ),
    "wild": (
        "The paper prints its own FID on Story, 56.57, in bold as the best; NPC's is lower, 53.62.",
        "The paper's Chamfer distance is 0.047 in one table and 0.048 in another; the mean of its subjects is 0.048.",
        "The unit of the paper's Chamfer distance and its normal consistency are unknown; its sizes fit square metres "
        "times 100, which CD is here, and the mean absolute cosine, which NC is here.",
        "In parentheses behind LPIPS and FID: the paper's two videos, Story / Invisible.",
    ),
    "ablation": (
        "The paper's full model on subject 394 has other numbers in its table of frequencies (30.36, 0.967, 30.03): "
        "two trainings, whose novel-view PSNRs differ by 0.32 dB; most of its ablations are as close to each other.",
    ),
    "frequency": (
        "The paper's full model on subject 394 has other numbers in its table of ablations (30.68, 0.967, 29.74).",
        "The paper trains and prints [10] once and shows it as w/o {s1, c1}, too.",
    ),
    "beyond": (
        "The paper gives all parts of the body the same bands and leaves others open; it has no numbers of these.",
    ),
    "consistency": (
        "The paper does not define its flow score; the number in parentheses cannot be compared with ours.",
    ),
    "masks": (),
}
"""What a reader should know about the paper's numbers, by table."""


def printed(table: str, subject: str, row: str, column: str) -> float | None:
    """A number of the paper; None where it prints none.

    Args:
        table: one of `PRINTED`.
        subject: AVERAGE, or a subject's name that holds its number, such as "CoreView_377".
        row: of the table.
        column: of the paper's table.

    >>> printed("main", AVERAGE, "Ours", "view PSNR"), printed("subjects", "CoreView_377", "NPC", "pose KID")
    (30.11, 4.42)
    """
    tables = PRINTED[table]
    match = re.search(rf"(?<!\d)({'|'.join(SUBJECTS)})(?!\d)", subject)
    rows = tables.get(match[1] if match else subject, {})
    return rows.get(row, {}).get(column)
