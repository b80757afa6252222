"""Durable exactly-once delivery of records between processes: store, outbox, inbox, protocol, scheduler."""
