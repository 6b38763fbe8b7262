"""Newport ESP controllers: ESP301, ESP300 and ESP100."""
