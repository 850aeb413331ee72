"""Adapters to other code bases, one module each; installed as `ca_reg.integrations`."""
