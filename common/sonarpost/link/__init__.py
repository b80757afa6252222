"""The acoustic link without input or output: wire formats, coding, authentication, queues and medium access."""
