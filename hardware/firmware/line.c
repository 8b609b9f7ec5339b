#include "line.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <stdlib.h>
#include <string.h>
#include <util/crc16.h>

#define BAUD 115200
#define RECEIVED_SIZE 128 // a power of two, and longer than a line

uint16_t line_garbled;

static volatile uint8_t received[RECEIVED_SIZE], received_head, received_tail;
static volatile bool received_lost;
// A request is taken only after its predecessor was answered, so the longest reply fits. Indices wrap by themselves.
static volatile uint8_t sent[256], sent_head, sent_tail;

static char text[LINE_SIZE];
static uint8_t length;
static bool damaged;
static uint8_t crc;

void line_init(void)
{
    UBRR0 = (F_CPU + 4UL * BAUD) / (8UL * BAUD) - 1; // 16 at 16 MHz: 2.1 % fast, as on every Arduino
    UCSR0A = _BV(U2X0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

ISR(USART_RX_vect)
{
    uint8_t status = UCSR0A; // must be read before the byte that it belongs to
    uint8_t byte = UDR0;
    uint8_t next = (received_head + 1) & (RECEIVED_SIZE - 1);
    if (status & (_BV(FE0) | _BV(DOR0)))
        received_lost = true;
    if (next == received_tail) {
        received_lost = true;
        return;
    }
    received[received_head] = byte;
    received_head = next;
}

ISR(USART_UDRE_vect)
{
    if (sent_tail == sent_head)
        UCSR0B &= ~_BV(UDRIE0);
    else
        UDR0 = sent[sent_tail++];
}

// Return the value of two upper-case hexadecimal digits, or -1.
static int16_t hex_byte(const char *digits)
{
    int16_t value = 0;
    for (uint8_t i = 0; i < 2; i++) {
        char digit = digits[i];
        value <<= 4;
        if (digit >= '0' && digit <= '9')
            value |= digit - '0';
        else if (digit >= 'A' && digit <= 'F')
            value |= digit - 'A' + 10;
        else
            return -1;
    }
    return value;
}

// Cut the CRC off; false where it is missing or wrong.
static bool checked(void)
{
    if (damaged || length < 3 || text[length - 3] != '*' || memchr(text, '\0', length))
        return false;
    uint8_t expected = 0;
    for (uint8_t i = 0; i < length - 3; i++)
        expected = _crc8_ccitt_update(expected, text[i]);
    text[length] = '\0';
    if (hex_byte(text + length - 2) != expected)
        return false;
    text[length - 3] = '\0';
    return true;
}

enum arrival line_poll(char **line)
{
    while (received_tail != received_head) {
        char byte = received[received_tail];
        received_tail = (received_tail + 1) & (RECEIVED_SIZE - 1);
        if (received_lost) {
            received_lost = false;
            damaged = true;
        }
        if (byte == '\r')
            continue;
        if (byte != '\n') {
            if (length == LINE_SIZE - 1)
                damaged = true;
            else
                text[length++] = byte;
            continue;
        }
        if (!length && !damaged)
            continue; // an empty line ends whatever the line noise has left; it is no request
        bool good = checked();
        length = 0;
        damaged = false;
        *line = text;
        if (good)
            return REQUEST;
        line_garbled++;
        return GARBLED;
    }
    return NOTHING;
}

static void put(char byte)
{
    while ((uint8_t)(sent_head + 1) == sent_tail)
        ; // the port empties the buffer whether anybody listens or not
    crc = _crc8_ccitt_update(crc, byte);
    sent[sent_head++] = byte;
    UCSR0B |= _BV(UDRIE0);
}

void line_text(const char *flash_text)
{
    for (char byte; (byte = pgm_read_byte(flash_text)); flash_text++)
        put(byte);
}

void line_begin(const char *sequence)
{
    crc = 0;
    while (*sequence)
        put(*sequence++);
}

void line_number(const char *flash_name, uint32_t value)
{
    char digits[11];
    line_text(flash_name);
    ultoa(value, digits, 10);
    for (const char *digit = digits; *digit; digit++)
        put(*digit);
}

void line_end(void)
{
    static const char hex[] PROGMEM = "0123456789ABCDEF";
    uint8_t sum = crc;
    put('*');
    put(pgm_read_byte(hex + (sum >> 4)));
    put(pgm_read_byte(hex + (sum & 15)));
    put('\n');
}
