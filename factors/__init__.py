"""Factors for 360-degree bundle adjustment on GTSAM."""
