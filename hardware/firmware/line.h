// Lines of text over the serial port: `<sequence> <words> *<CRC-8>`. docs/trigger_box.md has the protocol.
#pragma once

#include <avr/pgmspace.h>
#include <stdbool.h>
#include <stdint.h>

// The longest request has seven numbers of ten digits.
#define LINE_SIZE 96

void line_init(void);

// Lines that arrived damaged since ARM.
extern uint16_t line_garbled;

enum arrival { NOTHING, REQUEST, GARBLED };

// Take what has arrived. On REQUEST, `line` holds the text before the CRC, which was right, until the next call.
enum arrival line_poll(char **line);

// Write one line: begin, any number of the others, end. They wait for room, at most 23 ms, and never for the host.
void line_begin(const char *sequence);
void line_text(const char *flash_text);
void line_number(const char *flash_name, uint32_t value);
void line_end(void);
