// Numbered pulses at two outputs, and what camera and projector report back. Times are ticks of 0.5 us.
#pragma once

#include <stdbool.h>
#include <stdint.h>

#define TICK_NS 500
// An edge is prepared in the interrupt of the one before it. 50 us leave room for every other interrupt to come first:
// docs/trigger_box.md has the longest that was measured. An edge that is prepared too late stops the burst.
#define MIN_WIDTH 100UL
#define MIN_GAP 100UL
#define MIN_PERIOD 400UL
// Times are compared as differences of 32 bits with a sign.
#define MAX_PERIOD 2000000000UL
#define LOG_SIZE 128 // strobes that are remembered: half of the RAM

struct pulse {
    uint32_t delay, width;
};

struct train {
    uint32_t period, count; // count 0: until it is stopped
    struct pulse projector, camera;
    bool strobe, vsync; // which inputs are wired
};

enum state {
    IDLE,    // nothing was set since the start
    READY,   // set
    ARMED,   // waits for FIRE
    RUNNING, // until the end of the last period
    DONE,
    STOPPED, // by STOP
    SILENT,  // stopped because the host said nothing
    LATE,    // stopped because an edge could not be prepared in time
    SHORTED, // stopped because an output did not follow
};

struct strobe {
    uint32_t pulse, offset; // the camera pulse that it followed, and the ticks since the start of that period
};

struct counts {
    uint32_t projector, camera; // pulses begun
    uint32_t strobes, vsyncs;   // exposures that followed a camera pulse, and pictures
    uint16_t strays;            // exposures before the first camera pulse
    uint16_t noise; // edges at the strobe input less than 90 us after another: no exposures
    uint16_t worst; // ticks that the slowest preparation of an edge took
};

void pulses_init(void);
uint32_t pulses_ticks(void);       // since the start, modulo 2^32
uint32_t pulses_milliseconds(void); // since the start, modulo 2^32
enum state pulses_state(void);

// Return NULL, or the name in flash of the value that is out of its limits; then nothing changes.
const char *pulses_set(const struct train *train);
const struct train *pulses_train(void);
void pulses_arm(void);
uint32_t pulses_fire(void); // returns the tick at which the burst starts
void pulses_stop(enum state why); // STOPPED or SILENT
bool pulses_poll(void); // call often; true once, when a burst has ended
void pulses_counts(struct counts *counts);
// Copy a strobe by its number, counted from 0 since ARM; false where it is forgotten or has not come.
bool pulses_strobe(uint32_t number, struct strobe *strobe);
