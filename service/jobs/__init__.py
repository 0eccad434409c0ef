"""Jobs of the service: queue, processes, progress, results, webhooks, retention."""
