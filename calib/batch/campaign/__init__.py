"""Campaigns: a plan of many fits and diagnoses in, a folder of results and their summary out."""

from calib.batch.campaign.plan import Plan, read_plan
from calib.batch.campaign.run import Summary, run_campaign

__all__ = ["Plan", "Summary", "read_plan", "run_campaign"]
