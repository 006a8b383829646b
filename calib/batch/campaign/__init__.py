"""Campaigns: a plan of many fits and diagnoses in, a folder of results and their summary out."""

from calib.batch.campaign.run import Plan, Summary, read_plan, run_campaign

__all__ = ["Plan", "Summary", "read_plan", "run_campaign"]
