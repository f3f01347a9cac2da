"""Ask a running session for something, through the same services that ROS tools call."""

from __future__ import annotations

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from std_srvs.srv import Trigger

from rtest_estimation.errors import UserError

# Time for the graph to be found, and for an answer [s].
_FIND_S, _ANSWER_S = 5.0, 5.0
_SETTLE_S = 0.5


def ask_session(wish: str, domain: int, namespace: str = '') -> str:
    """Call the service `session/WISH` of the session in a ROS domain; returns its answer.

    Raises UserError where there is no session, or where it does not answer.
    """
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node(
        'ask', namespace=namespace, context=context, use_global_arguments=False,
    )
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        client = node.create_client(Trigger, f'session/{wish}')
        if not client.wait_for_service(_FIND_S):
            where = f' in namespace {namespace}' if namespace else ''
            raise UserError(
                f'no session in ROS domain {domain}{where}; --domain is what the session was '
                'started with'
            )
        # A service is seen a little before its answers find their way back.
        executor.spin_once(_SETTLE_S)
        future = client.call_async(Trigger.Request())
        executor.spin_until_future_complete(future, _ANSWER_S)
        if not future.done():
            raise UserError(f'the session did not answer within {_ANSWER_S:.0f} s; try again')
        answer = future.result()
        if not answer.success:
            raise UserError(answer.message)
        return answer.message
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
