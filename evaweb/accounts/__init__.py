"""Accounts: roles, credentials, passwords, cookies and the audit of logins."""
