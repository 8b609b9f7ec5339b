// Runs the trigger box's firmware in libsimavr: its serial port on a pseudo-terminal, its pins' edges in a CSV file.
//
//   simavr_host FIRMWARE.elf EDGES.csv SPEED
//
// SPEED: how many times as fast as the true board, at most; 0: as fast as it goes.
// Prints "PTY <path>", then "OK <answer>" for every line of standard input, and ends when that does, so that it never
// outlives the test that started it:
//
//   sync                  answers the cycle, and whether projector and camera output are high; EDGES.csv is complete
//   reset CAUSE           restart with this MCUSR (1 power-on, which forgets the RAM; 2 external; 4 brown-out)
//   hang 0|1              let the program loop for ever, 1: with its interrupts off
//   block MICROSECONDS    keep all interrupts off for this long
//   short P|C             let an output miss its next edge
//   strobe DELAY WIDTH    microseconds after each camera pulse, an exposure at the strobe input; WIDTH 0: none
//   drop N                leave the next N exposures out
//   vsync PERIOD          microseconds between the projector's pictures; 0: none
//   noise S|V PERIOD N    N edges at an input, PERIOD cycles apart
//   mute N                lose the next N lines that the firmware sends
//
// EDGES.csv: cycle,pin,level with pins P projector, C camera, S strobe, V vsync. 16 cycles are a microsecond.

#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include <avr_ioport.h>
#include <avr_uart.h>
#include <sim_avr.h>
#include <sim_elf.h>
#include <sim_irq.h>

#define HZ 16000000ULL
#define SLICE (HZ / 5000) // cycles between two looks at the outside world: 0.2 ms of the board's time

static avr_t *avr;
static FILE *edges;
static int pty = -1;
static bool uart_takes = true;
static avr_irq_t *uart_input;
static long mute;

static char level[128]; // of each pin, by its letter

static uint64_t strobe_delay, strobe_width, vsync_period;
static long drops;

// The cycle in which what happens now was due. libsimavr calls its timers after the running instruction, up to three
// cycles late, with the slot of the one that it calls in neither of its lists.
static avr_cycle_count_t due(void)
{
    avr_cycle_timer_pool_t *pool = &avr->cycle_timers;
    bool listed[MAX_CYCLE_TIMERS] = {false};
    for (avr_cycle_timer_slot_p slot = pool->timer; slot; slot = slot->next)
        listed[slot - pool->timer_slots] = true;
    for (avr_cycle_timer_slot_p slot = pool->timer_free; slot; slot = slot->next)
        listed[slot - pool->timer_slots] = true;
    for (int i = 0; i < MAX_CYCLE_TIMERS; i++)
        if (!listed[i])
            return pool->timer_slots[i].when;
    return avr->cycle; // an instruction did it
}

static void record(char pin, bool high)
{
    if (level[(int)pin] == high)
        return;
    level[(int)pin] = high;
    fprintf(edges, "%llu,%c,%d\n", (unsigned long long)due(), pin, high);
}

static void drive(char pin, bool high)
{
    record(pin, high);
    char port = pin == 'S' ? 'B' : 'D';
    int bit = pin == 'S' ? 0 : 4;
    // Without this, every change of the same port's outputs puts the pull-up's level back.
    avr_ioport_external_t held = {.name = port, .mask = 1 << bit, .value = high << bit};
    avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(port), &held);
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(port), bit), high);
}

static avr_cycle_count_t strobe_down(avr_t *mcu, avr_cycle_count_t when, void *unused)
{
    drive('S', false);
    return 0;
}

static avr_cycle_count_t strobe_up(avr_t *mcu, avr_cycle_count_t when, void *unused)
{
    drive('S', true);
    avr_cycle_timer_register(avr, strobe_width, strobe_down, NULL);
    return 0;
}

static avr_cycle_count_t vsync_edge(avr_t *mcu, avr_cycle_count_t when, void *unused)
{
    drive('V', !level['V']);
    return vsync_period ? when + vsync_period / 2 : 0;
}

static char noise_pin;
static uint64_t noise_period;
static long noise_left;

static avr_cycle_count_t noise_edge(avr_t *mcu, avr_cycle_count_t when, void *unused)
{
    drive(noise_pin, !level[(int)noise_pin]);
    return --noise_left > 0 ? when + noise_period : 0;
}

// Pins of port B that libsimavr 1.6 has raised at the timer's overflow: it does that where a match is to clear them.
static uint8_t raised;

static void output_changed(avr_irq_t *irq, uint32_t value, void *name)
{
    char pin = *(const char *)name;
    bool high = value & 0xff; // above are flags
    bool rises = high && !level[(int)pin];
    uint8_t mode = avr->data[0x80]; // TCCR1A
    if (rises && (pin == 'P' ? (mode & 0xC0) == 0x80 : (mode & 0x30) == 0x20)) {
        raised |= pin == 'P' ? 2 : 4;
        return;
    }
    record(pin, high);
    if (pin != 'C' || !rises || !strobe_width)
        return;
    if (drops)
        drops--;
    else
        avr_cycle_timer_register(avr, strobe_delay, strobe_up, NULL);
}

static avr_cycle_count_t matched_at;

static void compare_matched(avr_irq_t *irq, uint32_t value, void *unused)
{
    if (value)
        matched_at = due();
}

// Run an instruction. libsimavr 1.6 repeats a match when one compare register is written in the very cycle in which the
// other one has matched, so the program, not the timer, waits for that cycle to pass.
static int step(void)
{
    int state = avr_run(avr);
    if (avr->cycle == matched_at)
        avr->cycle++;
    for (int bit = 1; raised; raised &= ~(1 << bit++)) // before the program sees it
        if (raised & 1 << bit)
            avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), bit), AVR_IOPORT_OUTPUT);
    return state;
}

static void sent_by_firmware(avr_irq_t *irq, uint32_t value, void *unused)
{
    char byte = value;
    if (mute) {
        mute -= byte == '\n';
        return;
    }
    // Where nobody reads, it is lost, as on a true serial line.
    if (write(pty, &byte, 1) < 0)
        return;
}

static void uart_ready(avr_irq_t *irq, uint32_t value, void *unused)
{
    uart_takes = true;
}

static void uart_full(avr_irq_t *irq, uint32_t value, void *unused)
{
    uart_takes = false;
}

static void feed_uart(void)
{
    char byte;
    while (uart_takes && read(pty, &byte, 1) == 1)
        avr_raise_irq(uart_input, (unsigned char)byte);
}

// Send the program into a loop in the last word of the flash, which no program reaches.
static void hang(bool with_interrupts_off)
{
    avr->flash[avr->flashend - 1] = 0xFF; // rjmp to itself
    avr->flash[avr->flashend] = 0xCF;
    avr->pc = avr->flashend - 1;
    if (with_interrupts_off)
        avr->sreg[S_I] = avr->interrupt_state = 0;
}

static avr_flashaddr_t blocked_at;
static avr_cycle_count_t blocked_until;

static void block(avr_cycle_count_t cycles)
{
    for (int i = 0; i < 100000 && !avr->sreg[S_I]; i++) // not in the middle of an interrupt
        step();
    blocked_at = avr->pc;
    blocked_until = avr->cycle + cycles;
    hang(true);
}

static void unblock(void)
{
    blocked_until = 0;
    avr->pc = blocked_at;
    avr->sreg[S_I] = 1;
    avr->interrupt_state = -1; // it looks for pending ones after the next instruction
}

static void restart(int cause)
{
    drops = noise_left = 0;
    blocked_until = 0;
    avr_reset(avr);
    // The chip lets go of its pins, and the pull-downs take them low.
    record('P', false);
    record('C', false);
    drive('S', false);
    drive('V', false);
    if (cause & 1)
        for (int address = 0x100; address <= avr->ramend; address++)
            avr->data[address] = 0xA5 ^ address;
    avr->data[0x54] = cause; // MCUSR
    if (vsync_period)
        avr_cycle_timer_register(avr, vsync_period / 2, vsync_edge, NULL);
    uart_takes = true;
}

static void obey(const char *line)
{
    char word[16] = "", pin = 0;
    long a = 0, b = 0;
    if (sscanf(line, "noise %c %ld %ld", &pin, &a, &b) == 3) {
        noise_pin = pin;
        noise_period = a;
        noise_left = b;
        avr_cycle_timer_register(avr, noise_period, noise_edge, NULL);
        printf("OK\n");
        return;
    }
    if (sscanf(line, "short %c", &pin) == 1) {
        avr->data[0x25] ^= pin == 'P' ? 2 : 4; // of PORTB, from which the next toggle goes back
        printf("OK\n");
        return;
    }
    sscanf(line, "%15s %ld %ld", word, &a, &b);
    if (!strcmp(word, "sync")) {
        fflush(edges);
        printf("OK %llu %d %d\n", (unsigned long long)avr->cycle, level['P'], level['C']);
        return;
    } else if (!strcmp(word, "reset")) {
        restart(a);
    } else if (!strcmp(word, "hang")) {
        hang(a);
    } else if (!strcmp(word, "block")) {
        block(a * (HZ / 1000000));
    } else if (!strcmp(word, "strobe")) {
        strobe_delay = a * (HZ / 1000000) + !a;
        strobe_width = b * (HZ / 1000000);
    } else if (!strcmp(word, "drop")) {
        drops = a;
    } else if (!strcmp(word, "mute")) {
        mute = a;
    } else if (!strcmp(word, "vsync")) {
        bool runs = vsync_period;
        vsync_period = a * (HZ / 1000000);
        if (!runs && vsync_period)
            avr_cycle_timer_register(avr, vsync_period / 2, vsync_edge, NULL);
    } else {
        printf("UNKNOWN %s\n", word);
        return;
    }
    printf("OK\n");
}

// Obey what stands in standard input; false when it has ended.
static bool control(void)
{
    static char line[128];
    static size_t length;
    struct pollfd ready = {.fd = STDIN_FILENO, .events = POLLIN};
    while (poll(&ready, 1, 0) > 0) {
        char byte;
        if (read(STDIN_FILENO, &byte, 1) != 1)
            return false;
        if (byte != '\n') {
            if (length < sizeof line - 1)
                line[length++] = byte;
            continue;
        }
        line[length] = '\0';
        length = 0;
        obey(line);
        fflush(stdout);
    }
    return true;
}

static void open_pty(void)
{
    pty = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (pty < 0 || grantpt(pty) || unlockpt(pty)) {
        perror("pty");
        exit(1);
    }
    const char *path = ptsname(pty);
    // Kept open, so that the line is not lost whenever a client closes it.
    int slave = open(path, O_RDWR | O_NOCTTY);
    struct termios raw;
    tcgetattr(slave, &raw);
    cfmakeraw(&raw);
    tcsetattr(slave, TCSANOW, &raw);
    printf("PTY %s\n", path);
    fflush(stdout);
}

static void connect_pins(void)
{
    static const char projector[] = "P", camera[] = "C";
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 1), output_changed, (void *)projector);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('B'), 2), output_changed, (void *)camera);
}

static void connect_matches(void)
{
    static const int compare_a = 11, compare_b = 12; // vectors
    avr_irq_register_notify(avr_get_interrupt_irq(avr, compare_a) + AVR_INT_IRQ_PENDING, compare_matched, NULL);
    avr_irq_register_notify(avr_get_interrupt_irq(avr, compare_b) + AVR_INT_IRQ_PENDING, compare_matched, NULL);
}

static void connect_uart(void)
{
    uint32_t flags = 0; // neither print what is sent, nor sleep where the firmware waits
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    uart_input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), sent_by_firmware, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), uart_ready, NULL);
    avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), uart_full, NULL);
}

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

// Wait until the world has come as far as the board, and no longer than a slice: never catch up what was lost.
static void pace(double speed)
{
    static double due;
    double now = seconds();
    due += SLICE / (speed * HZ);
    if (due < now - 0.01)
        due = now;
    if (due > now + 0.001) {
        struct timespec rest = {.tv_nsec = (long)(1e9 * (due - now))};
        nanosleep(&rest, NULL);
    }
}

int main(int count, char **arguments)
{
    elf_firmware_t firmware = {0};
    if (count != 4 || elf_read_firmware(arguments[1], &firmware) || !(edges = fopen(arguments[2], "w"))) {
        fprintf(stderr, "usage: simavr_host FIRMWARE.elf EDGES.csv SPEED\n");
        return 1;
    }
    double speed = atof(arguments[3]);
    avr = avr_make_mcu_by_name("atmega328p");
    avr_init(avr);
    firmware.frequency = HZ;
    avr_load_firmware(avr, &firmware);
    fprintf(edges, "cycle,pin,level\n");
    connect_pins();
    connect_matches();
    connect_uart();
    open_pty();
    restart(1);
    while (control()) {
        feed_uart();
        for (avr_cycle_count_t end = avr->cycle + SLICE; avr->cycle < end;) {
            int state = step();
            if (state == cpu_Crashed || state == cpu_Done) {
                fprintf(stderr, "the firmware crashed\n");
                return 1;
            }
            if (blocked_until && avr->cycle >= blocked_until)
                unblock();
        }
        if (speed > 0)
            pace(speed);
    }
    fclose(edges);
    return 0;
}
