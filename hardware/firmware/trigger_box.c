// Trigger box: numbered pulses for a projector and a camera. docs/trigger_box.md has protocol, wiring and limits.

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>
#include <string.h>

#include "line.h"
#include "pulses.h"

#define PROTOCOL 1
#define FIRMWARE "1.0.0"
#define BOARD "atmega328p"
// Longer than a host needs to ask twice; a camera that is triggered for nobody should not go on for ever.
#define HOST_SILENCE_MS 5000UL

// The watchdog must not find us in a loop that never was: it stays on through its own reset.
static uint8_t cause __attribute__((section(".noinit")));
__attribute__((naked, used, section(".init3"))) static void remember_cause(void)
{
    cause = MCUSR;
    MCUSR = 0;
    wdt_disable();
}

// The boot number is another one after every restart. Warm restarts are counted in RAM, which they leave alone; the
// EEPROM, which bears 100,000 writes, counts only those that lost it.
static struct {
    uint16_t cold, warm, check;
} boot __attribute__((section(".noinit")));

static void count_boot(void)
{
    if (boot.check == (uint16_t)(boot.cold ^ boot.warm ^ 0xC0DE)) {
        boot.warm++;
    } else {
        boot.cold = eeprom_read_word(0) + 1;
        boot.warm = 0;
        eeprom_update_word(0, boot.cold);
    }
    boot.check = boot.cold ^ boot.warm ^ 0xC0DE;
}

#define TEXT(words) line_text(PSTR(words))
#define NUMBER(name, value) line_number(PSTR(name), value)

static void put_boot(void)
{
    NUMBER(" boot=", (uint32_t)boot.cold << 16 | boot.warm);
    NUMBER(" cause=", cause);
}

static void put_state(void)
{
    static const char names[][8] PROGMEM = {"IDLE", "READY",   "ARMED",  "RUNNING", "DONE",
                                            "STOPPED", "SILENT", "LATE", "SHORTED"};
    TEXT(" state=");
    line_text(names[pulses_state()]);
}

static void put_train(void)
{
    put_boot();
    const struct train *train = pulses_train();
    NUMBER(" period=", train->period);
    NUMBER(" count=", train->count);
    NUMBER(" projector=", train->projector.delay);
    NUMBER(",", train->projector.width);
    NUMBER(" camera=", train->camera.delay);
    NUMBER(",", train->camera.width);
    NUMBER(" strobe=", train->strobe);
    NUMBER(" vsync=", train->vsync);
}

static void put_counts(void)
{
    struct counts counts;
    pulses_counts(&counts);
    NUMBER(" pulses=", counts.camera);
    NUMBER(" projector=", counts.projector);
    NUMBER(" strobes=", counts.strobes);
    NUMBER(" strays=", counts.strays);
    NUMBER(" vsyncs=", counts.vsyncs);
    NUMBER(" noise=", counts.noise);
    NUMBER(" worst=", counts.worst);
}

// Each command writes the rest of its reply, from the word after the sequence number.

static bool stray_words(const char *words)
{
    if (!*words)
        return false;
    TEXT(" ERR ARGUMENT none expected");
    return true;
}

// Read a number of decimal digits and the blank behind it; false where there is none, or it is too large.
static bool take_number(const char **words, uint32_t *value)
{
    const char *digit = *words;
    *value = 0;
    for (; *digit >= '0' && *digit <= '9'; digit++) {
        uint8_t ones = *digit - '0';
        if (*value > (UINT32_MAX - ones) / 10)
            return false;
        *value = *value * 10 + ones;
    }
    if (digit == *words || (*digit != ' ' && *digit != '\0'))
        return false;
    *words = *digit ? digit + 1 : digit;
    return true;
}

static void identify(const char *words)
{
    if (stray_words(words))
        return;
    TEXT(" OK colorphase-trigger-box firmware=" FIRMWARE " board=" BOARD);
    NUMBER(" protocol=", PROTOCOL);
}

static void limits(const char *words)
{
    if (stray_words(words))
        return;
    NUMBER(" OK tick_ns=", TICK_NS);
    NUMBER(" min_period=", MIN_PERIOD);
    NUMBER(" max_period=", MAX_PERIOD);
    NUMBER(" min_width=", MIN_WIDTH);
    NUMBER(" min_gap=", MIN_GAP);
    NUMBER(" max_count=", UINT32_MAX);
    NUMBER(" log=", LOG_SIZE);
    NUMBER(" silence_ms=", HOST_SILENCE_MS);
}

static void wrong_state(void)
{
    TEXT(" ERR STATE");
    put_state();
}

static void set(const char *words)
{
    uint32_t inputs;
    struct train train;
    uint32_t *const values[] = {&train.period,          &train.count,        &train.projector.delay,
                                &train.projector.width, &train.camera.delay, &train.camera.width,
                                &inputs};
    for (uint8_t i = 0; i < sizeof values / sizeof *values; i++)
        if (!take_number(&words, values[i])) {
            TEXT(" ERR ARGUMENT seven numbers expected");
            return;
        }
    if (stray_words(words))
        return;
    if (pulses_state() == ARMED || pulses_state() == RUNNING) {
        wrong_state();
        return;
    }
    train.strobe = inputs & 1;
    train.vsync = inputs & 2;
    const char *wrong = inputs > 3 ? PSTR("inputs") : pulses_set(&train);
    if (wrong) {
        TEXT(" ERR LIMIT ");
        line_text(wrong);
        return;
    }
    TEXT(" OK");
    put_train();
}

static void arm(const char *words)
{
    if (stray_words(words))
        return;
    if (pulses_state() == IDLE || pulses_state() == RUNNING) {
        wrong_state();
        return;
    }
    pulses_arm();
    line_garbled = 0;
    TEXT(" OK");
    put_train();
}

static void fire(const char *words)
{
    if (stray_words(words))
        return;
    if (pulses_state() == ARMED)
        NUMBER(" OK start=", pulses_fire());
    else
        wrong_state();
}

static void stop(const char *words)
{
    pulses_stop(STOPPED); // whatever else the line says
    TEXT(" OK");
    put_state();
}

static void status(const char *words)
{
    if (stray_words(words))
        return;
    TEXT(" OK");
    put_state();
    put_boot();
    NUMBER(" up=", pulses_milliseconds());
    NUMBER(" tick=", pulses_ticks());
    put_counts();
    NUMBER(" garbled=", line_garbled);
}

static void read_log(const char *words)
{
    uint32_t number;
    if (!take_number(&words, &number)) {
        TEXT(" ERR ARGUMENT one number expected");
        return;
    }
    if (stray_words(words))
        return;
    struct counts counts;
    pulses_counts(&counts);
    if (counts.strobes > LOG_SIZE && number < counts.strobes - LOG_SIZE)
        number = counts.strobes - LOG_SIZE;
    NUMBER(" OK strobes=", counts.strobes);
    NUMBER(" from=", number);
    struct strobe strobe;
    // Six fit into the send buffer. If new ones overwrite the next one meanwhile, the reply ends there.
    for (uint8_t i = 0; i < 6 && pulses_strobe(number + i, &strobe); i++) {
        NUMBER(" ", strobe.pulse);
        NUMBER(",", strobe.offset);
    }
}

static const struct {
    char name[7];
    void (*reply)(const char *words);
} commands[] PROGMEM = {
    {"ID", identify}, {"LIMITS", limits}, {"SET", set},       {"ARM", arm},
    {"FIRE", fire},   {"STOP", stop},     {"STATUS", status}, {"LOG", read_log},
};

static void answer(char *request)
{
    char *name = strchr(request, ' ');
    if (!name || name == request || name - request > 4) {
        line_begin("?");
        TEXT(" ERR LINE a sequence number of one to four characters and a command expected");
        line_end();
        return;
    }
    *name++ = '\0';
    char *words = strchr(name, ' ');
    if (words)
        *words++ = '\0';
    line_begin(request);
    uint8_t i = 0, count = sizeof commands / sizeof *commands;
    while (i < count && strcmp_P(name, commands[i].name))
        i++;
    if (i == count) {
        TEXT(" ERR COMMAND unknown");
    } else {
        void (*reply)(const char *) = (void (*)(const char *))pgm_read_word(&commands[i].reply);
        reply(words ? words : "");
    }
    line_end();
}

int main(void)
{
    pulses_init();
    count_boot();
    line_init();
    wdt_enable(WDTO_120MS);
    sei();

    line_begin("!");
    TEXT(" BOOT");
    put_boot();
    line_end();

    uint32_t heard = 0;
    for (;;) {
        wdt_reset();
        char *request;
        switch (line_poll(&request)) {
        case REQUEST:
            heard = pulses_ticks();
            answer(request);
            break;
        case GARBLED:
            line_begin("?");
            TEXT(" ERR LINE damaged");
            line_end();
            break;
        case NOTHING:
            break;
        }
        if (pulses_state() == RUNNING && pulses_ticks() - heard > HOST_SILENCE_MS * (1000000UL / TICK_NS))
            pulses_stop(SILENT);
        if (pulses_poll()) {
            line_begin("!");
            TEXT(" END");
            put_state();
            put_counts();
            line_end();
        }
    }
}
