#include "pulses.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <string.h>
#include <util/atomic.h>

// The edges are made by the timer's compare units, to the clock cycle; the program only says in time which comes next.
// Timer 1 runs freely at 2 MHz and is never written, so that every time refers to one clock.
//
// A compare unit has two ways to drive its pin: toggle at a match, or leave it to the port. "Toggle" is chosen only for
// the match that makes an edge, and the port holds the pin over longer stretches. Two habits are there for simavr 1.6,
// where the tests run, and are as good on the chip: it obeys "set" and "clear" also when the timer overflows, so they are
// not used; and it takes any write to TIFR1 for one that clears all flags, so there is none.

#define PROJECTOR_PIN _BV(PB1) // OC1A, D9
#define CAMERA_PIN _BV(PB2)    // OC1B, D10
#define STROBE_PIN _BV(PB0)    // ICP1, D8
#define VSYNC_PIN _BV(PD4)     // T0, D4

#define LEAD 200UL       // ticks from FIRE to the burst's start: enough to prepare both outputs
#define HOP 0x8000UL     // ticks to a match on the way to an edge that is further off than the timer counts
#define STROBE_REST 180UL // ticks that lie at least between two exposures: less than half of MIN_PERIOD

struct output {
    uint32_t high_ticks, low_ticks; // of the pulse, and from its end to the next one
    uint32_t rest;                  // ticks from the next match to the edge; 0: that match is the edge
    uint32_t rise;                  // tick at which the pulse rises that is being made, or comes next
    uint32_t left;                  // pulses that have not ended; an endless train counts down from 2^32
    bool high, active;
};

// What tells the two outputs apart; constant, so that it costs nothing.
struct unit {
    volatile uint16_t *compare;
    uint8_t toggle, clear, force, pin;
};
static const struct unit projector_unit = {&OCR1A, _BV(COM1A0), _BV(COM1A1), _BV(FOC1A), PROJECTOR_PIN};
static const struct unit camera_unit = {&OCR1B, _BV(COM1B0), _BV(COM1B1), _BV(FOC1B), CAMERA_PIN};

static struct train train;
static struct output projector, camera;
static volatile enum state state;
static volatile enum state failure; // LATE or SHORTED: both outputs were released; pulses_poll tells it
static bool listening; // strobes are counted
static bool fired;     // and its end is still to be told
static uint32_t ended; // tick at which the burst ended
static volatile uint32_t overflows;
static uint32_t strobes, vsyncs;
static volatile uint8_t strobes_logged;   // what the interrupt counts, modulo 256: at 5 kHz that lasts for 50 ms
static uint8_t strobes_seen, vsyncs_seen; // of it, and of the counter of vsyncs
static uint32_t last_strobe;
static volatile uint16_t strays, noise, worst;
static struct {
    uint32_t left, since; // pulses that were left, ticks since the rise of the pulse
} strobe_log[LOG_SIZE];

#define INLINE static inline __attribute__((always_inline))

ISR(TIMER1_OVF_vect)
{
    overflows++;
}

// Widen a time of the timer that is not older than half its round. Interrupts are off.
INLINE uint32_t widened(uint16_t time)
{
    uint16_t rounds = overflows;
    if ((TIFR1 & _BV(TOV1)) && time < 0x8000)
        rounds++; // it has overflowed and could not say so yet
    return (uint32_t)rounds << 16 | time;
}

// Take an output low for good. Interrupts are off.
INLINE void release(struct output *output, const struct unit *unit)
{
    TCCR1A = (TCCR1A & ~unit->toggle) | unit->clear; // from here on a match can only clear
    __asm__ volatile("nop");                         // the input register lags behind by a cycle
    if (PINB & unit->pin)
        output->high = true; // also where its last pulse began in this very moment
    PORTB &= ~unit->pin;
    TCCR1C = unit->force; // clears the compare unit's own latch
    TCCR1A &= ~unit->clear;
    output->active = false;
}

// End the burst now, outputs low. Interrupts are off.
static void halt(enum state why)
{
    release(&projector, &projector_unit);
    release(&camera, &camera_unit);
    state = why;
    ended = widened(TCNT1);
}

// Prepare the next match, for an edge `ticks` after `from`, a time of the timer that has just passed. Interrupts are off.
INLINE void prepare(struct output *output, const struct unit *unit, uint16_t from, uint32_t ticks)
{
    uint16_t hop = ticks > 0xFFFF ? HOP : ticks;
    *unit->compare = from + hop;
    if (ticks > 0xFFFF) {
        if (output->high)
            PORTB |= unit->pin;
        else
            PORTB &= ~unit->pin;
        TCCR1A &= ~unit->toggle;
    } else {
        TCCR1A |= unit->toggle;
    }
    uint16_t spent = TCNT1 - from;
    output->rest = ticks - hop;
    if (spent > worst)
        worst = spent;
    if (spent >= hop)
        failure = LATE; // the match may have been missed, and would come only after another round
}

INLINE void matched(struct output *output, const struct unit *unit)
{
    if (!output->active)
        return;
    uint16_t now = *unit->compare;
    uint32_t rest = output->rest;
    if (rest) {
        prepare(output, unit, now, rest);
    } else if (output->high == !!(PINB & unit->pin)) {
        failure = SHORTED; // the edge was not made; or it was one too many, and all that follow were upside down
    } else if (!output->high) {
        output->high = true;
        prepare(output, unit, now, output->high_ticks);
    } else {
        output->high = false;
        if (--output->left == 0)
            release(output, unit);
        else
            prepare(output, unit, now, output->low_ticks);
        if (output == &camera)
            output->rise += train.period;
    }
    if (failure) { // released here and not in a function, so that no registers are saved for a call
        release(&projector, &projector_unit);
        release(&camera, &camera_unit);
    }
}

ISR(TIMER1_COMPA_vect)
{
    matched(&projector, &projector_unit);
}

ISR(TIMER1_COMPB_vect)
{
    matched(&camera, &camera_unit);
}

// The strobe: the timer itself notes when. After an edge that comes too early to be an exposure the interrupt rests, as a
// loose wire must not take the time that the outputs need.
ISR(TIMER1_CAPT_vect)
{
    uint32_t now = widened(ICR1);
    bool early = now - last_strobe < STROBE_REST;
    last_strobe = now;
    if (early) {
        noise++;
        TIMSK1 &= ~_BV(ICIE1);
        return;
    }
    if (!listening)
        return;
    uint32_t since = now - camera.rise;
    uint32_t left = camera.left;
    // By the times, not by the interrupts: that of the pulse may still be waiting.
    if (!camera.high && (!camera.active || (int32_t)since < 0)) {
        if (left == train.count) {
            strays++;
            return;
        }
        since += train.period; // it followed the pulse before
        left++;
    }
    uint8_t entry = strobes_logged++ & (LOG_SIZE - 1);
    strobe_log[entry].left = left;
    strobe_log[entry].since = since;
}

void pulses_init(void)
{
    PORTB = STROBE_PIN; // pull-ups: an input without a wire must not wander. Outputs low before they are outputs.
    PORTD = VSYNC_PIN;
    DDRB = PROJECTOR_PIN | CAMERA_PIN;
    TCCR0B = _BV(CS02) | _BV(CS01) | _BV(CS00); // timer 0 counts rising edges of the vsync, without any program
    TCCR1A = 0;
    TCCR1B = _BV(ICNC1) | _BV(ICES1) | _BV(CS11); // capture rising edges of four equal samples; clock / 8
    TIMSK1 = _BV(OCIE1A) | _BV(OCIE1B) | _BV(TOIE1);
}

static uint32_t read(const volatile uint32_t *value)
{
    uint32_t copy;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) copy = *value;
    return copy;
}

uint32_t pulses_ticks(void)
{
    uint32_t now;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) now = widened(TCNT1);
    return now;
}

uint32_t pulses_milliseconds(void)
{
    uint32_t rounds = read(&overflows);
    return rounds * 32 + rounds / 125 * 96 + rounds % 125 * 96 / 125; // 32.768 ms a round, without overflowing
}

enum state pulses_state(void)
{
    return state;
}

const struct train *pulses_train(void)
{
    return &train;
}

INLINE void rewind_output(struct output *output, const struct pulse *pulse)
{
    output->high_ticks = pulse->width;
    output->low_ticks = train.period - pulse->width;
    output->left = train.count;
    output->high = false;
}

// Go back to the first pulse, with nothing counted. Interrupts are off.
static void rewind(enum state next)
{
    rewind_output(&projector, &train.projector);
    rewind_output(&camera, &train.camera);
    strobes = vsyncs = 0;
    strobes_logged = strobes_seen = 0;
    strays = noise = worst = 0;
    listening = false;
    failure = IDLE;
    state = next;
}

static bool fits(const struct pulse *pulse, uint32_t period)
{
    return pulse->delay <= period && pulse->width <= period - pulse->delay
           && period - pulse->delay - pulse->width >= MIN_GAP;
}

const char *pulses_set(const struct train *asked)
{
    if (asked->period < MIN_PERIOD || asked->period > MAX_PERIOD)
        return PSTR("period");
    if (asked->projector.width < MIN_WIDTH)
        return PSTR("projector_width");
    if (!fits(&asked->projector, asked->period))
        return PSTR("projector_gap");
    if (asked->camera.width < MIN_WIDTH)
        return PSTR("camera_width");
    if (!fits(&asked->camera, asked->period))
        return PSTR("camera_gap");
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        train = *asked;
        rewind(READY);
    }
    return NULL;
}

void pulses_arm(void)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) rewind(ARMED);
}

INLINE void start(struct output *output, const struct unit *unit, const struct pulse *pulse, uint32_t now)
{
    output->rise = now + LEAD + pulse->delay;
    output->active = true;
    prepare(output, unit, now, LEAD + pulse->delay - 1); // a pin changes one tick after its match
}

uint32_t pulses_fire(void)
{
    uint32_t now;
    // What the compare units still hold must not match while they are prepared.
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) OCR1A = OCR1B = TCNT1 - 2;
    // Nor must an older match be told once they are. Both may wait by now, and between two interrupts the chip runs one
    // instruction, which would be the one that keeps the second out.
    while (TIFR1 & (_BV(OCF1A) | _BV(OCF1B)))
        ;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        vsyncs_seen = TCNT0;
        listening = fired = true;
        state = RUNNING;
        now = widened(TCNT1);
        start(&projector, &projector_unit, &train.projector, now);
        start(&camera, &camera_unit, &train.camera, now);
        worst = 0; // of the burst itself
    }
    return now + LEAD;
}

void pulses_stop(enum state why)
{
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        if (state == RUNNING)
            halt(why);
        else if (state == ARMED)
            state = READY;
    }
}

static void poll_strobes(void)
{
    uint8_t seen = strobes_logged;
    strobes += (uint8_t)(seen - strobes_seen);
    strobes_seen = seen;
}

// Look at the inputs, every 128 us at most.
static void poll_inputs(void)
{
    static uint8_t last;
    uint8_t now = pulses_ticks() >> 8;
    if (now == last)
        return;
    last = now;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        if (!(TIMSK1 & _BV(ICIE1)) && (TIFR1 & _BV(ICF1)))
            last_strobe = widened(ICR1); // an edge that came while the interrupt rested is noise, too
        if (train.strobe)
            TIMSK1 |= _BV(ICIE1);
        else
            TIMSK1 &= ~_BV(ICIE1);
    }
    poll_strobes();
    uint8_t seen = TCNT0;
    if (state == RUNNING && train.vsync)
        vsyncs += (uint8_t)(seen - vsyncs_seen);
    vsyncs_seen = seen;
}

bool pulses_poll(void)
{
    poll_inputs();
    bool at_rest; // then no interrupt changes anything any more
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) at_rest = !projector.active && !camera.active;
    uint32_t now = pulses_ticks();
    if (state == RUNNING && at_rest) {
        if (failure) {
            ATOMIC_BLOCK(ATOMIC_RESTORESTATE) halt(failure);
        } else if ((int32_t)(now - (camera.rise - train.camera.delay)) >= 0) {
            // Only at the end of the last period, so that the next burst cannot come too early for the camera.
            state = DONE;
            ended = now;
        }
    }
    // The last exposure may be reported a little later.
    if (listening && state != RUNNING && now - ended >= train.period)
        listening = false;
    bool over = fired && state != RUNNING;
    if (over)
        fired = false;
    return over;
}

static uint32_t begun(const struct output *output)
{
    uint32_t count;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) count = train.count - output->left + output->high;
    return count;
}

void pulses_counts(struct counts *counts)
{
    poll_strobes(); // before the pulses, of which there must not be fewer
    counts->strobes = strobes;
    counts->projector = begun(&projector);
    counts->camera = begun(&camera);
    counts->vsyncs = vsyncs;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        counts->strays = strays;
        counts->noise = noise;
        counts->worst = worst;
    }
}

bool pulses_strobe(uint32_t number, struct strobe *strobe)
{
    uint8_t entry = number & (LOG_SIZE - 1);
    uint8_t behind;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        strobe->pulse = train.count - strobe_log[entry].left;
        strobe->offset = strobe_log[entry].since + train.camera.delay;
        behind = strobes_logged - strobes_seen; // those came since `strobes` was counted
    }
    return number < strobes && strobes + behind - number <= LOG_SIZE;
}
