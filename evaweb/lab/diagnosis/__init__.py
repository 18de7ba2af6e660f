"""Diagnostic bundle: the state of a lab in one file that can be passed on, without secrets and with blinding
respected.
"""
