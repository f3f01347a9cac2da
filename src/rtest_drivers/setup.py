from glob import glob

from setuptools import find_packages, setup

NAME = 'rtest_drivers'

setup(
    name=NAME,
    version='0.1.0',
    packages=find_packages(include=[NAME, f'{NAME}.*']),
    package_data={NAME: [f'**/*.{kind}' for kind in ('yaml', 'html', 'css', 'js', 'j2')]},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        (f'share/{NAME}/launch', sorted(glob('launch/*.launch.py'))),
        (f'share/{NAME}/config', sorted(glob('config/*.*'))),
    ],
    install_requires=['setuptools'],
    extras_require={'test': ['pytest']},
    zip_safe=False,
    maintainer='R-test developers',
    maintainer_email='rtest@example.com',
    description='Gauges, CNC, recorder, replay, simulated cell and the command rtest.',
    license='Apache-2.0',
    entry_points={
        'console_scripts': [
            'rtest = rtest_drivers.cli:main',
            'gauges = rtest_drivers.nodes.gauges:main',
            'cnc = rtest_drivers.nodes.cnc:main',
            'thermometers = rtest_drivers.nodes.thermometers:main',
            'recorder = rtest_drivers.nodes.recorder:main',
            'replay = rtest_drivers.nodes.replay:main',
            'session = rtest_drivers.nodes.session:main',
            'cell = rtest_drivers.nodes.cell:main',
            'view = rtest_drivers.nodes.view:main',
            'frames = rtest_drivers.nodes.frames:main',
        ],
    },
)
