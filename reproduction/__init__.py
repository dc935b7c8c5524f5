"""The paper's experiments, end to end: `python -m reproduction --profile quick --out out/quick`.

The study is a list of stages (`study.py`), each a function that writes files from the files of others.
`stages.py` runs those that are missing or out of date, and the page is drawn from their files. Plots and
pages are made with the names that `forcegp.report` exports.
"""
