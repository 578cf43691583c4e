"""Viewers of a live page that read all messages: `page_viewers.py URL N`.

They simulate browsers on other machines, and run at a lower priority than the measured process. The
amount received is printed to show that the viewers did receive messages.
"""

import asyncio
import os
import signal
import sys

from websockets.asyncio.client import connect


async def receive_all(url, sizes):
    """Read all messages as one viewer, and append their sizes [bytes] to `sizes`."""
    async with connect(url.replace('http', 'ws') + 'stream', max_size=None,
                       compression=None) as viewer:
        async for message in viewer:
            sizes.append(len(message))


async def main(url, n):
    """Run `n` viewers until SIGTERM, and print the amount received."""
    sizes = [[] for _ in range(n)]
    tasks = [asyncio.create_task(receive_all(url, one)) for one in sizes]
    asyncio.get_running_loop().add_signal_handler(
        signal.SIGTERM, lambda: [task.cancel() for task in tasks])
    results = await asyncio.gather(*tasks, return_exceptions=True)
    lost = sum(not isinstance(e, asyncio.CancelledError) for e in results)
    counts = [len(one) for one in sizes]
    print(f'{n}, each {min(counts)} to {max(counts)} messages, {sum(sizes[0]) / 1e6:.1f} MB; '
          f'{lost} disconnected')


if __name__ == '__main__':
    os.nice(19)
    asyncio.run(main(sys.argv[1], int(sys.argv[2])))
