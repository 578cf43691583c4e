// When preloaded, this library makes a process hang where Fast DDS 2.14 sometimes does
// (eProsima/Fast-DDS 6513): in DomainParticipant::set_listener(nullptr), while a participant is
// destroyed.

#include <unistd.h>

extern "C" int set_listener(void*, void* listener) __asm__(
    "_ZN8eprosima7fastdds3dds17DomainParticipant12set_listenerEPNS1_25DomainParticipantListenerE");

extern "C" int set_listener(void*, void* listener) {
    while (!listener) usleep(100000);
    return 0;
}
