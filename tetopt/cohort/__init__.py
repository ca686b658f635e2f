"""Cohorts: hundreds of subjects, each meshed by a process of its own, on a cluster; resumed, and judged at a glance."""
