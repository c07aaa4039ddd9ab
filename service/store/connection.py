"""The connection that every operation of the store is handed."""

import sqlite3

Connection = sqlite3.Connection
