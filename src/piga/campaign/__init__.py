"""Campaigns: thousands of tests on one machine or many. They resume after any interruption, with identical results."""

from piga.campaign.campaign_file import CampaignPlan, read_campaign
from piga.campaign.collect import Collected, collect
from piga.campaign.shards import Campaign, RunReport, open_campaign, plan_campaign, run_campaign

__all__ = [
    "Campaign",
    "CampaignPlan",
    "Collected",
    "RunReport",
    "collect",
    "open_campaign",
    "plan_campaign",
    "read_campaign",
    "run_campaign",
]
