// Asks unit 1 for register 1003h through a std::fstream on the serial port that its argument names.
#include <cstdio>
#include <fstream>
#include <unistd.h>

int main(int, char **argument)
{
    static const char request[] = {1, 3, 0x10, 3, 0, 1, 0x70, static_cast<char>(0xCA)};
    char answer[7] = {};
    sleep(1);
    std::fstream port(argument[1], std::ios::in | std::ios::out | std::ios::binary);
    if (!port) return 4;
    port.write(request, sizeof request).flush();
    port.read(answer, sizeof answer);
    for (char one : answer) std::printf("%02X ", static_cast<unsigned char>(one));
    std::printf("\n");
    return port ? 0 : 5;
}
