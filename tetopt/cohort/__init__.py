"""Cohorts: hundreds of subjects, each meshed by its own process, on a cluster; resumable, with
an overview page.
"""
