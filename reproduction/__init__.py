"""The paper's experiments, end to end: `python -m reproduction --profile quick --out out/quick`.

The study is a list of stages (`study.py`), functions that compute output files from the files of other
stages. `stages.py` runs those that are missing or out of date, and functions of `forcegp.report` generate the
page.
"""
