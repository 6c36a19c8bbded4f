"""A cluster that exists already, whose machines share nothing with the night's but an object store."""
